"""Seed bugs into a copy of the tree, one at a time, and see whether the tests catch them.

    python studies/seed_bugs.py [--jobs 2] [--only WORD ...]

A bug is an exact piece of source and what to put in its place; `studies/seeded_bugs.py` lists them. Each is planted
in a copy of kernels/, src/ and tests/ under a temporary folder with a kernel cache of its own, and the tests of its
operator are run until the first that fails. The exit code is 1 if a bug is missed, if a patch no longer applies, or
if the tests fail without any bug.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from seeded_bugs import BUGS, Bug

ROOT = Path(__file__).resolve().parent.parent
TREE = ("kernels/oasis_kernels", "src", "tests", "studies", "asset_build", "pyproject.toml")
LIMIT = 240
"""Seconds that the tests of one bug may take: a kernel that never ends is caught by it."""


class Outcome(NamedTuple):
    """What the tests said to one bug."""

    bug: Bug
    verdict: str
    """caught, missed, or stale: the piece of source is not there exactly once."""
    test: str
    seconds: float


def copy_tree(folder: Path) -> Path:
    """A copy of what the tests need."""
    for part in TREE:
        target = folder / part
        target.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / part, target)
    return folder


def run_tests(folder: Path, cache: Path, tests: Sequence[str]) -> tuple[bool, str]:
    """Whether all pass, and the first that does not."""
    environment = os.environ | {
        "PYTHONPATH": f"{folder}/src:{folder}/kernels",
        "PYTHONDONTWRITEBYTECODE": "1",  # a patch of the same length in the same second would run as it was before
        "OASIS_WARP_CACHE": str(cache),
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", "-p", "no:randomly", *tests]
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return False, f"no end within {LIMIT} s"
    first = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode == 0:
        return True, ""
    return False, first[1] if first else f"pytest ended with {done.returncode}: {(done.stdout + done.stderr)[-300:]}"


def plant(bug: Bug, folder: Path, cache: Path) -> Outcome:
    """Run the tests with one bug in place; the copy is as before afterwards."""
    start = time.monotonic()
    file = folder / bug.path
    source = file.read_text()
    if source.count(bug.old) != 1:
        return Outcome(bug, "stale", f"{source.count(bug.old)} times in {bug.path}", 0.0)
    file.write_text(source.replace(bug.old, bug.new))
    try:
        passed, test = run_tests(folder, cache, bug.tests)
    finally:
        file.write_text(source)
    return Outcome(bug, "missed" if passed else "caught", test, time.monotonic() - start)


def main(arguments: Sequence[str] | None = None) -> int:
    """Plant every bug; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2, help="copies of the tree that are worked on at once")
    parser.add_argument("--only", nargs="*", default=[], help="only bugs with one of these words in their names")
    options = parser.parse_args(arguments)
    bugs = [bug for bug in BUGS if not options.only or any(word in bug.name for word in options.only)]
    with tempfile.TemporaryDirectory(prefix="seeded_bugs_") as place:
        cache = Path(place) / "kernels"
        copies = [copy_tree(Path(place) / f"copy_{i}") for i in range(options.jobs)]
        for tests in dict.fromkeys(bug.tests for bug in bugs):
            passed, test = run_tests(copies[0], cache, tests)  # which also builds the kernels without bugs
            if not passed:
                print(f"{' '.join(tests)}: fails without a bug: {test}")
                return 1
        free = list(copies)

        def work(bug: Bug) -> Outcome:
            folder = free.pop()
            try:
                return plant(bug, folder, cache)
            finally:
                free.append(folder)

        outcomes = []
        with ThreadPoolExecutor(options.jobs) as pool:
            for outcome in pool.map(work, bugs):
                outcomes.append(outcome)
                print(f"{outcome.verdict:7} {outcome.seconds:5.1f} s  {outcome.bug.name}: {outcome.test}", flush=True)
    bad = [outcome for outcome in outcomes if outcome.verdict != "caught"]
    print(f"{len(outcomes) - len(bad)} of {len(outcomes)} bugs caught.")
    return 1 if bad or not outcomes else 0


if __name__ == "__main__":
    sys.exit(main())
