"""Do one thing again and again: does memory stay flat? `python3 tests/fuzz/memory_run.py renders --jobs 12`.

Each of the jobs is a process of its own with one thread, which notes its memory after a thousand times (a tenth of its
share if that is less), every `EVERY` seconds and at its end, as lines of JSON in --out. What stands there counts: the
same command goes on until all jobs together have --count, or --seconds are over. Then it prints a line of JSON with the
growth of each process's memory since its first note; the exit code is 1 if one grew by more than `MAX_GROWTH`.
"""

import argparse
import collections
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS.parent / "src"), str(TESTS.parent / "kernels"), str(TESTS)]
os.environ["OMP_NUM_THREADS"] = "1"

import torch  # noqa: E402 - the paths come first
from fuzz.targets import HandEstimator, bundled_hand, plain_photo, read_photo, small_avatar  # noqa: E402
from fuzz.victims import lend_filter  # noqa: E402

from oasis_warp.core.camera import orbit_camera  # noqa: E402
from oasis_warp.hand_avatar import Avatar  # noqa: E402

PHOTO = TESTS / "data" / "photos" / "ok_sign_left_10.jpg"
POSES = ("open", "fist", "victory", "point")
COUNTS = {"renders": 100_000, "fits": 10_000, "opened": 20_000, "read": 20_000}
EARLY = 1000
"""Times after which the memory is noted first, if a job's share is ten times that."""
EVERY = 20.0
FIT_PIXELS = 160 * 160
"""Of the photo that is fitted: the hand in it is some 100 pixels large."""
MAX_GROWTH = 2.0
"""Of memory since its first note [%]."""


def renders(folder: Path) -> Callable[[int], object]:
    """Pictures of 32 pixels in changing poses and views, in their light."""
    avatar = small_avatar(lit=True)
    cameras = [orbit_camera(avatar.rest.vertices, 0.1 * k, size=32) for k in range(60)]
    return lambda k: avatar.render(cameras[k % 60], POSES[k % len(POSES)]).image


def opened(folder: Path) -> Callable[[int], object]:
    """An avatar file, read and forgotten."""
    small_avatar(lit=True).save(folder / "a.safetensors")
    return lambda k: Avatar.load(folder / "a.safetensors").rest


def fits(folder: Path) -> Callable[[int], object]:
    """The fit of one small photo's landmarks."""
    estimator, photo = HandEstimator(bundled_hand()), read_photo(PHOTO, max_pixels=FIT_PIXELS)
    landmarks = estimator.find(photo)[0]
    return lambda k: estimator.fit(photo, landmarks, force=True)


def read(folder: Path) -> Callable[[int], object]:
    """Landmarks and mask found in a picture without a hand."""
    estimator, (photo, *_) = HandEstimator(bundled_hand()), plain_photo()
    return lambda k: estimator.find(photo)


KINDS = {make.__name__: make for make in (renders, fits, opened, read)}


def memory() -> int:
    """Bytes of this process that are in memory, on Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def work(kind: str, job: str, count: int, end: float, out: Path) -> None:
    """Repeat `count` times or until `end`, and note how much memory it takes."""
    torch.set_num_threads(1)
    lend_filter()

    def note() -> None:
        line = {"kind": kind, "job": job, "done": done, "MB": round(memory() / 2**20, 2)}
        with out.open("a") as file:  # a short line is written at once
            file.write(json.dumps({**line, "seconds": round(time.monotonic() - start, 1)}) + "\n")

    with tempfile.TemporaryDirectory() as folder:
        repeat, done, start = KINDS[kind](Path(folder)), 0, time.monotonic()
        noted, early = start, max(1, min(EARLY, count // 10))
        while done < count and time.monotonic() < end:
            repeat(done)
            done += 1
            if done == early or (done > early and time.monotonic() > noted + EVERY):
                noted = time.monotonic()
                note()
        if done > early:
            note()


def read_lines(out: Path, kind: str) -> list[dict[str, Any]]:
    """What stands in a file of this kind; a line that was cut off does not count."""
    lines = []
    for text in out.read_text().splitlines() if out.is_file() else ():
        try:
            lines.append(json.loads(text))
        except ValueError:
            continue
    return [line for line in lines if line["kind"] == kind]


def total(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """What all processes did, and the growth of the memory of each that noted it twice."""
    jobs = collections.defaultdict(list)
    for line in lines:
        jobs[line["job"]].append(line)
    growth = [100 * (max(line["MB"] for line in notes) / notes[0]["MB"] - 1) for notes in jobs.values() if notes[1:]]
    first, last = [notes[0] for notes in jobs.values()], [notes[-1] for notes in jobs.values()]
    done, seconds = sum(line["done"] for line in last), sum(line["seconds"] for line in last)
    return {
        "done": done, "processes": len(last), "most of one": max((line["done"] for line in last), default=0),
        "first note after": min((line["done"] for line in first), default=0),
        "MB": max((line["MB"] for line in last), default=0), "most growth %": round(max(growth), 2) if growth else None,
        "seconds of one": round(seconds / max(done, 1), 4),
    }  # fmt: skip


def main() -> int:
    """Read the command line, repeat in all jobs, and print; the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--count", type=int, help=f"Times in all; by default {COUNTS}.")
    parser.add_argument("--jobs", type=int, default=1, help="Processes at the same time.")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="Of the whole run, at most.")
    parser.add_argument("--out", type=Path, default=Path("memory.jsonl"))
    options = parser.parse_args()
    end, count = time.monotonic() + options.seconds, options.count or COUNTS[options.kind]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    left = max(0, count - total(read_lines(options.out, options.kind))["done"])
    context, jobs = multiprocessing.get_context("spawn"), []
    for k in range(min(options.jobs, left)):
        share = left // options.jobs + (k < left % options.jobs)
        name = f"{os.getpid()}.{k}.{time.time_ns()}"
        jobs.append(context.Process(target=work, args=(options.kind, name, share, end, options.out)))
        jobs[-1].start()
    for job in jobs:
        job.join()
    found = {"kind": options.kind, **total(read_lines(options.out, options.kind))}
    found["failed"] = sum(job.exitcode != 0 for job in jobs)
    print(json.dumps(found))
    return int(bool(found["failed"] or (found["most growth %"] or 0) > MAX_GROWTH))


if __name__ == "__main__":
    sys.exit(main())
