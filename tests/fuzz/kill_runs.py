"""Kill commands at random moments: `python tests/fuzz/kill_runs.py render --count 60 --seed 1`.

After each SIGKILL the output must be complete or absent, as far as its final name goes; after one whole run at the end
nothing else may be left beside it. Each run ends at a moment of its own, most of them near the end, where files are
written. Prints a line of JSON.
"""

import argparse
import contextlib
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
from safetensors import safe_open

from oasis_warp.data.output_files import output_folder

TOP = Path(__file__).parents[2]
PHOTO = TOP / "src" / "oasis_warp" / "assets" / "photos" / "palm_open_left_02.png"
WHOLE = {
    "render": {"out.png"},
    "edit": {"out.safetensors", "out.png", "out.json"},
    "reconstruct": {"avatar.safetensors", "summary.png", "quality.png", "turntable.mp4", "report.json"},
}


def command(name: str, folder: Path) -> list[str]:
    """The command, whose output goes to `folder`/out."""
    oasis, inputs, out = [sys.executable, "-m", "oasis_warp"], folder.parent, folder / "out"
    if name == "reconstruct":
        return [*oasis, "reconstruct", str(PHOTO), "-o", str(folder), "--size", "64", "--steps", "2"]
    avatar = str(inputs / "made" / "avatar.safetensors")
    if name == "render":
        return [*oasis, "render", avatar, "-o", f"{out}.png", "--size", "128"]
    painted = [str(inputs / "painted.png"), "--photo", str(PHOTO), "--steps", "2", "--size", "64", "--overwrite"]
    return [*oasis, "edit", avatar, *painted, "-o", f"{out}.safetensors"]


def check(folder: Path, whole: set[str]) -> str:
    """"complete" or "absent"; anything else says what is wrong."""
    found = {path.name for path in folder.iterdir() if not path.name.startswith(".")} if folder.is_dir() else set()
    if found and found != whole:
        return f"half: {sorted(found)}"
    for name in found:
        path = folder / name
        if name.endswith(".png") and cv2.imread(str(path)) is None:
            return f"broken: {name}"
        if name.endswith(".json"):
            json.loads(path.read_text())
        if name.endswith(".safetensors"):
            with safe_open(path, framework="np") as file:
                file.keys()
    return "complete" if found else "absent"


WRITER = """
import sys
from pathlib import Path
from oasis_warp.data.output_files import output_folder, write_file
folder, version = Path(sys.argv[1]), int(sys.argv[2])
print("ready", flush=True)
while True:
    version += 1
    with output_folder(folder) as part:
        for name in "abc":
            (part / name).write_text(f"{version} " * 1000)
    write_file(folder / "d", f"{version} ".encode() * 1000)
"""
"""Writes the same files again and again, each time of another version."""


def kill_writers(count: int, rng: random.Random) -> dict[str, int]:
    """Kill a process that does nothing but write: what is left is of one version once the next run has begun."""
    counts, version = {"one version": 0, "mixed": 0, "cut": 0, "left": 0}, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "out"
        for _ in range(count):
            command = [sys.executable, "-c", WRITER, str(folder), str(version)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE)
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(rng.uniform(0, 0.05))
            process.kill()
            process.wait()
            process.stdout.close()
            with contextlib.suppress(InterruptedError), output_folder(folder):
                raise InterruptedError  # a next run, which fails
            found = [file.read_text().split() for file in sorted(folder.glob("[abc]"))]
            whole = [file.read_text().split() for file in sorted(folder.glob("[abcd]"))]
            counts["cut"] += any(len(words) != 1000 or len(set(words)) != 1 for words in whole)
            counts["one version" if len({words[0] for words in found}) <= 1 and len(found) in (0, 3) else "mixed"] += 1
            version = max([version, *(int(words[0]) for words in whole)])
            counts["left"] += sum(path.name.startswith(".") and ".d." not in path.name for path in folder.glob(".*"))
    return counts


def main() -> None:
    """Read the command line, kill the command again and again, and print what was left."""
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=["files", *sorted(WHOLE)])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    if options.command == "files":
        print(json.dumps({"kills": options.count, **kill_writers(options.count, rng)}))
        return
    counts: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as name:
        top = Path(name)
        folder = top / "work"
        if options.command != "reconstruct":
            made = [sys.executable, "-m", "oasis_warp", "reconstruct", str(PHOTO), "-o", str(top / "made")]
            subprocess.run([*made, "--size", "256", "--steps", "2"], check=True, capture_output=True)
            picture = cv2.imread(str(PHOTO))
            assert picture is not None
            height, width = picture.shape[:2]
            cv2.circle(picture, (width // 2, height // 2), width // 20, (0, 0, 255), -1)
            cv2.imwrite(str(top / "painted.png"), picture)
        start = time.monotonic()
        subprocess.run(command(options.command, folder), check=True, capture_output=True)
        seconds = time.monotonic() - start
        for _ in range(options.count):
            for path in folder.glob("[!.]*"):  # each kill meets what the kills before left hidden, and no output
                path.unlink()
            process = subprocess.Popen(
                command(options.command, folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            try:
                process.wait(seconds * (rng.uniform(0, 1.1) if rng.random() < 0.3 else rng.uniform(0.8, 1.1)))
                counts["not killed"] = counts.get("not killed", 0) + 1
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
            left = check(folder, WHOLE[options.command])
            counts[left] = counts.get(left, 0) + 1
        hidden = sum(path.name.startswith(".") for path in (*folder.glob(".*"), *top.glob(".*")))
        done = subprocess.run(command(options.command, folder), capture_output=True)
        after = check(folder, WHOLE[options.command])
        rest = [path.name for path in (*folder.glob(".*"), *top.glob(".*"))]
    report = {"command": options.command, "kills": options.count, "seconds": round(seconds, 1), **counts}
    print(json.dumps({**report, "hidden before": hidden, "exit": done.returncode, "after": after, "hidden": rest}))


if __name__ == "__main__":
    main()
