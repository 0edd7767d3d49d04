"""Thousands of damaged files: `PYTHONPATH=tests python tests/fuzz/long_run.py avatars --count 3000 --seed 1`.

Each batch runs in a process of its own, so that a crash is counted and the rest goes on. Prints a line of JSON.
"""

import argparse
import collections
import json
import multiprocessing
import tempfile
from collections.abc import Callable
from pathlib import Path

BATCH = 500
"""Files a process."""
KINDS = ("avatars", "weights", "keypoints", "fits", "estimates", "images", "splats", "motions", "mano", "data_sets",
         "requests")  # fmt: skip
PATIENCE = 300.0
"""Seconds to wait for one file, on a machine that is busy with other things."""


def make_target(name: str, folder: Path):
    """The target of a name, with everything it can do."""
    from fuzz import targets

    if name == "avatars":
        return targets.avatars(folder, lit=True)
    if name in ("weights", "splats", "motions", "mano", "data_sets", "requests"):
        return getattr(targets, name)(folder)
    if name == "images":
        return targets.images(avif=True)
    if name == "estimates":
        return targets.estimates()
    pose = targets.small_avatar(lit=False).source_pose
    if name == "keypoints":
        return targets.keypoints(*targets.plain_photo(), pose, fit=False)
    photo = targets.read_photo(Path(__file__).parents[1] / "data" / "photos" / "ok_sign_left_10.jpg")
    return targets.keypoints(photo, targets.HandEstimator(targets.bundled_hand()).find(photo)[0], pose, fit=True)


def batch(name: str, seed: int, first: int, last: int, report: Callable[[tuple[int, str]], None]) -> None:
    """Run files `first` to `last` and report each outcome; "fault: ..." where something is wrong."""
    from fuzz.targets import run

    with tempfile.TemporaryDirectory() as folder:
        target = make_target(name, Path(folder))
        for index in range(first, last):
            report((index, "started"))
            try:
                report((index, run(target, seed, index, Path(folder))))
            except Exception as error:
                report((index, f"fault: {type(error).__name__}: {str(error)[:200]}"))


def main() -> None:
    """Read the command line, run all batches and print what happened."""
    parser = argparse.ArgumentParser()
    parser.add_argument("target", choices=KINDS)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    context, outcomes = multiprocessing.get_context("spawn"), {}
    first = 0
    while first < options.count:
        receiver, sender = context.Pipe(duplex=False)
        last = min(first + BATCH, options.count)
        child = context.Process(target=batch, args=(options.target, options.seed, first, last, sender.send))
        child.start()
        sender.close()
        reached = first
        try:
            while receiver.poll(PATIENCE):
                index, outcome = receiver.recv()
                outcomes[index], reached = outcome, index
            outcomes[reached] = "fault: hang"
        except EOFError:
            pass
        child.kill()
        child.join()
        if reached not in outcomes:
            raise SystemExit(f"{options.target}: cannot be made, exit code {child.exitcode}.")
        if outcomes.get(reached) == "started":
            outcomes[reached] = f"fault: exit code {child.exitcode}"
        first = reached + 1
    counts = collections.Counter(outcome.split(":")[0] for outcome in outcomes.values())
    faults = {index: outcome for index, outcome in outcomes.items() if outcome.startswith("fault")}
    print(json.dumps({"target": options.target, "seed": options.seed, **counts, "faults": faults}))


if __name__ == "__main__":
    main()
