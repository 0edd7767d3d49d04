"""What is imported for what: machines that train have few packages, and processes that plan start fast."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
STAGES = """
import sys

def lack(*names):
    sys.modules.update(dict.fromkeys(names))  # importing them fails

def have(*names):
    for name in names:
        del sys.modules[name]

lack("igl", "trimesh", "tyro", "rich", "anny", "scipy", "warp", "oasis_kernels")
from oasis_warp.hand.template import bundled_hand
bundled_hand()
have("scipy")
lack("scipy.ndimage")
from oasis_warp.core import processes
from oasis_warp.synthetic import skin_plan
skin_plan.bundled_atlas()
have("scipy.ndimage", "warp", "oasis_kernels")
import oasis_warp.synthetic.picture
import oasis_warp.evaluation.synthetic
import studies.network_parts
from oasis_warp.synthetic.body import bundled_body
bundled_body()
"""


def test_hands_load_skin_is_planned_and_people_are_baked_and_evaluated_with_what_each_needs():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    done = subprocess.run([sys.executable, "-c", STAGES], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def test_no_time_is_measured_by_the_clock_on_the_wall():
    """It jumps: remaining times would be negative, and limits would end what has just begun."""
    clocks = re.compile(r"time\.time\(|time_ns\(|datetime|\.utcnow|import time\b.*\btime\b")
    found = [path.name for path in (ROOT / "src").rglob("*.py") if clocks.search(path.read_text())]
    assert found == ["kernel_cache.py"]  # where it is held against the times of files
