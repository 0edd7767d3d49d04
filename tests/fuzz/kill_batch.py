"""Kill the parts of `oasis batch` at random moments: `python tests/fuzz/kill_batch.py worker --count 20 --seed 1`.

The victim is a worker, the scheduler of a cluster, or the client with its workers. Each SIGKILL comes while photos are
in work, and the same command goes on. At any time every result must be complete, and in the end every photo must have
one line in the manifest and one folder, and nothing else may be left. Prints a line of JSON.
"""

import argparse
import atexit
import contextlib
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import psutil

PHOTO = Path(__file__).parents[2] / "src" / "oasis_warp" / "assets" / "photos" / "palm_open_left_02.png"
QUICK = ("--size", "64", "--steps", "0", "--unseen", "plain", "--prior", "none")
WHOLE = {"made": {"avatar.safetensors", "report.json", "row.json"}, "refused": {"row.json"}}
LONGEST = 300
"""Seconds without anything new after which the work hangs."""


def draw_photos(folder: Path, count: int) -> None:
    """Different photos: two of three show a hand, the third shows none or is no picture."""
    picture = cv2.imread(str(PHOTO))
    assert picture is not None
    small = cv2.resize(picture, (192, 192 * len(picture) // picture.shape[1]), interpolation=cv2.INTER_AREA)
    folder.mkdir()
    for k in range(count):
        own = small.copy() if k % 3 else np.full_like(small, 90)
        own[0, 0] = k % 256, k // 256, 7
        data = cv2.imencode(".png", own)[1].tobytes()
        (folder / f"{k:04}.png").write_bytes(data[: len(data) // 2] if k % 9 == 0 else data)


class Cluster:
    """A client, and with `scheduler` also a scheduler and two workers of its own; all run as processes."""

    def __init__(self, photos: Path, out: Path, scheduler: bool):
        self.outside: list[psutil.Popen] = []
        where = ["--workers", "2"]
        if scheduler:
            dask = [sys.executable, "-m", "distributed.cli."]
            file = out.parent / "scheduler.json"
            file.unlink(missing_ok=True)
            web = ["--no-dashboard", "--dashboard-address", "127.0.0.1:0"]  # other schedulers run beside this one
            self._start([f"{dask[-1]}dask_scheduler", "--host", "127.0.0.1", "--port", "0", *web,
                         "--scheduler-file", str(file)])  # fmt: skip
            while not file.is_file():
                time.sleep(0.1)
            address = json.loads(file.read_text())["address"]
            for _ in range(2):
                self._start([f"{dask[-1]}dask_worker", address, "--nthreads", "1", *web])
            where = ["--scheduler", address]
        command = [sys.executable, "-m", "oasis_warp", "batch", str(photos), "-o", str(out), *QUICK, *where]
        self.client = psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    def _start(self, module: list[str]) -> None:
        command = [sys.executable, "-m", *module]
        self.outside.append(psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

    def workers(self) -> list[psutil.Process]:
        """The client's own."""
        children = self.client.children(recursive=True)
        return [child for child in children if "multiprocessing.spawn" in " ".join(child.cmdline())]

    def end(self) -> None:
        """Wait for all that has lost its scheduler or client, and end the rest."""
        everything = [self.client, *self.outside]
        everything += [child for process in self.outside if process.is_running() for child in process.children()]
        for process in self.outside:
            process.kill()
        psutil.wait_procs(everything, timeout=30)


def check(out: Path, counts: Counter[str]) -> None:
    """Count results that are not whole."""
    for folder in out.glob("avatars/??/[!.]*"):
        found = {path.name for path in folder.iterdir()}
        counts["half"] += found != WHOLE[json.loads((folder / "row.json").read_text())["status"]]


def check_end(photos: Path, out: Path, counts: Counter[str]) -> None:
    """Count what is wrong after a whole run."""
    names = sorted(path.name for path in photos.iterdir())
    rows = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    listed = Counter(row["photo"] for row in rows)
    folders = [path.name for path in out.glob("avatars/??/*")]
    counts["photos"] += len(names)
    counts["lost"] += sum(name not in listed for name in names) + sum(row.get("key") not in folders for row in rows)
    counts["double"] += sum(listed.values()) - len(listed) + len(folders) - len(names)
    counts["failed"] += sum(row["status"] == "failed" for row in rows)
    counts["left"] += sum(path.name.startswith(".") for path in out.rglob("*")) + (out / "tries").is_dir()


def is_working(out: Path, since: float) -> bool:
    """Whether a photo was begun after that time."""
    for path in out.glob("tries/*"):
        with contextlib.suppress(FileNotFoundError):  # it has ended
            if path.stat().st_mtime > since:
                return True
    return False


def kill_once(cluster: Cluster, victim: str, rng: random.Random, out: Path) -> bool:
    """Wait until photos are in work and a little longer, and kill; False if the work ends before."""
    begun = time.time()
    while not is_working(out, begun):
        if cluster.client.poll() is not None:
            return False
        assert time.time() < begun + LONGEST, "hangs"
        time.sleep(0.05)
    try:
        cluster.client.wait(rng.uniform(0, 5))
        return False
    except psutil.TimeoutExpired:
        pass
    workers = [] if victim == "scheduler" else cluster.workers()
    while victim == "worker" and not workers:  # those that were killed are being started again
        if cluster.client.poll() is not None:
            return False
        workers = cluster.workers()
    if victim == "worker":
        rng.choice(workers).kill()
        psutil.wait_procs(workers, timeout=0.2)
        return True
    process = cluster.client if victim == "client" else cluster.outside[0]
    process.kill()
    if victim == "scheduler":
        said = cluster.client.communicate(timeout=LONGEST)[1]
        assert cluster.client.returncode == 2 and "the scheduler is lost" in said, said
    else:
        assert not psutil.wait_procs(workers, timeout=30)[1], "workers outlive their client"
    cluster.end()
    return True


def main() -> None:
    """Read the command line, kill again and again, and print what was left."""
    parser = argparse.ArgumentParser()
    parser.add_argument("victim", choices=["worker", "scheduler", "client"])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--photos", type=int, default=36)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng, start = random.Random(options.seed), time.monotonic()
    counts, kills = Counter(dict.fromkeys(("half", "lost", "double", "failed", "left"), 0)), 0
    with tempfile.TemporaryDirectory() as name:
        photos, runs = Path(name) / "photos", 0
        draw_photos(photos, options.photos)
        while kills < options.count:
            out, runs = Path(name) / f"out{runs}", runs + 1
            code = None
            while code is None:  # until a run comes to its end
                cluster = Cluster(photos, out, options.victim == "scheduler")
                atexit.register(cluster.end)  # whatever goes wrong here
                while kills < options.count and kill_once(cluster, options.victim, rng, out):
                    kills += 1
                    check(out, counts)
                    if options.victim != "worker":
                        break
                else:
                    _, said = cluster.client.communicate(timeout=20 * LONGEST)
                    code = cluster.client.returncode
                    cluster.end()
                    assert code in (0, 2) and "Traceback" not in said, said
                    if code == 2:  # photos that were in work at three kills have failed, and are tried again
                        code = counts.update(["run again"])
            check(out, counts)
            check_end(photos, out, counts)
    report = {"victim": options.victim, "kills": kills, "runs": runs, **counts}
    print(json.dumps({**report, "seconds": round(time.monotonic() - start)}))


if __name__ == "__main__":
    main()
