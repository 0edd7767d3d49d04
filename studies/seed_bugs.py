"""Whether the tests catch bugs that are planted, one at a time, in a copy of the tree.

A bug is an exact piece of source and what to put in its place; `seeded_bugs` lists them. Each is planted in a copy of
kernels/, src/ and tests/ under a temporary folder with a kernel cache of its own, and the tests of its operator are run
until the first that fails. The exit code is 1 if a bug is missed, if a patch no longer applies, or if the tests fail
without any bug. Fills docs/certification.md (bugs).
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from studies.harness import Row, StudyOptions, write_rows
from studies.seeded_bugs import BUGS, Bug
from studies.tables import Section

ROOT = Path(__file__).resolve().parent.parent
TREE = ("kernels/oasis_kernels", "src", "tests", "studies", "asset_build", "pyproject.toml")
LIMIT = 240
"""Seconds that the tests of one bug may take: a kernel that never ends is caught by it."""
PLAIN = ("-p", "no:cacheprovider", "-p", "no:randomly")
"""Options of pytest: nothing is left in the copy, and the order is that of the files."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    workers: int = 2
    """Copies of the tree that are worked on at once."""
    only: tuple[str, ...] = ()
    """Only bugs with one of these words in their names."""


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
    command = [sys.executable, "-m", "pytest", "--slow", "-x", "-q", "-n0", *PLAIN, *tests]
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return False, f"no end within {LIMIT} s"
    first = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode == 0:
        return True, ""
    return False, first[1] if first else f"pytest ended with {done.returncode}: {(done.stdout + done.stderr)[-300:]}"


def plant(bug: Bug, folder: Path, cache: Path) -> Row:
    """Run the tests with one bug in place; the copy is as before afterwards."""
    start = time.monotonic()
    file = folder / bug.path
    source = file.read_text()

    def outcome(verdict: str, test: str, seconds: float) -> Row:
        print(f"{verdict:7} {seconds:5.1f} s  {bug.name}: {test}", flush=True)
        failed = verdict != "caught"
        return {"bug": bug.name, "verdict": verdict, "test": test, "seconds": seconds, "failed": failed}

    if source.count(bug.old) != 1:
        return outcome("stale", f"{source.count(bug.old)} times in {bug.path}", 0.0)
    file.write_text(source.replace(bug.old, bug.new))
    try:
        passed, test = run_tests(folder, cache, bug.tests)
    finally:
        file.write_text(source)
    return outcome("missed" if passed else "caught", test, time.monotonic() - start)


def run(options: Options) -> list[Row]:
    """Plant every bug."""
    bugs = [bug for bug in BUGS if not options.only or any(word in bug.name for word in options.only)]
    with tempfile.TemporaryDirectory(prefix="seeded_bugs_") as place:
        cache = Path(place) / "kernels"
        free = [copy_tree(Path(place) / f"copy_{k}") for k in range(options.workers)]
        for tests in dict.fromkeys(bug.tests for bug in bugs):
            passed, test = run_tests(free[0], cache, tests)  # which also builds the kernels without bugs
            if not passed:
                print(f"{' '.join(tests)}: fails without a bug: {test}")
                return [{"bug": "none", "verdict": "fails", "test": test, "failed": True}]

        def work(bug: Bug) -> Row:
            folder = free.pop()
            try:
                return plant(bug, folder, cache)
            finally:
                free.append(folder)

        with ThreadPoolExecutor(options.workers) as pool:
            rows = list(pool.map(work, bugs))
    return write_rows(options.out / "seed_bugs", rows) if rows else [{"bug": "none", "verdict": "none", "failed": True}]


def summary(rows: list[Row]) -> str:
    """How many were caught."""
    caught = sum(row["verdict"] == "caught" for row in rows)
    words = "plants one mistake at a time in a copy of the tree"
    return f"`python -m studies seed_bugs` {words}: {caught} of {len(rows)} bugs caught."


SECTIONS = (Section("certification.md", "bugs", summary),)
