"""Do one thing thousands of times: `PYTHONPATH=tests python tests/fuzz/memory_run.py renders --count 100000`.

Prints the process's memory after a hundredth (a thousand of 1e5) and at the end as a line of JSON: it must stay flat.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from fuzz.targets import HandEstimator, bundled_hand, plain_photo, read_photo, small_avatar

from oasis_warp.core.camera import orbit_camera
from oasis_warp.hand_avatar import Avatar

PHOTO = Path(__file__).parents[1] / "data" / "photos" / "ok_sign_left_10.jpg"
POSES = ("open", "fist", "victory", "point")


def renders(folder: Path) -> Callable[[int], object]:
    """Pictures of 64 pixels in changing poses and views."""
    avatar = small_avatar(lit=True)
    cameras = [orbit_camera(avatar.rest.vertices, 0.1 * k, size=64) for k in range(60)]
    return lambda k: avatar.render(cameras[k % 60], POSES[k % len(POSES)]).image


def opened(folder: Path) -> Callable[[int], object]:
    """An avatar file, read and forgotten."""
    small_avatar(lit=True).save(folder / "a.safetensors")
    return lambda k: Avatar.load(folder / "a.safetensors").rest


def fits(folder: Path) -> Callable[[int], object]:
    """The fit of one photo's landmarks."""
    estimator, photo = HandEstimator(bundled_hand()), read_photo(PHOTO)
    landmarks = estimator.find(photo)[0]
    return lambda k: estimator.fit(photo, landmarks)


def read(folder: Path) -> Callable[[int], object]:
    """Landmarks and mask found in a picture without a hand."""
    estimator, (photo, *_) = HandEstimator(bundled_hand()), plain_photo()
    return lambda k: estimator.find(photo)


def memory() -> int:
    """Bytes of this process that are in memory, on Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    """Read the command line, repeat, and print."""
    kinds = {make.__name__: make for make in (renders, opened, fits, read)}
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=kinds)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="Stop earlier after so long.")
    options = parser.parse_args()
    torch.set_num_threads(1)
    early, start = None, time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        work, done = kinds[options.kind](Path(folder)), 0
        while done < options.count and time.monotonic() - start < options.seconds:
            work(done)
            done += 1
            if done == max(1, options.count // 100):
                early = memory()
    late = memory()
    growth = None if early is None else round(100 * (late / early - 1), 2)
    megabytes = None if early is None else early >> 20
    found = {"kind": options.kind, "done": done, "MB after a hundredth": megabytes, "MB": late >> 20}
    print(json.dumps({**found, "growth %": growth, "seconds": round(time.monotonic() - start)}))


if __name__ == "__main__":
    main()
