"""`pytest kernels/benchmarks`, which no other test collects."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_microbenchmarks_are_collected_and_run():
    """A renamed function of `bench.speed` once broke all of them unseen."""
    small = {"BENCH_SIZE": "48", "BENCH_GAUSSIANS": "200"}
    options = ["-q", "--benchmark-disable", "-k", "visibility and warp"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "kernels/benchmarks", *options],
        cwd=ROOT, env=os.environ | small, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and " passed" in done.stdout, done.stdout + done.stderr
