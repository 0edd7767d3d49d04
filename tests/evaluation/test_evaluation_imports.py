import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_a_machine_with_the_core_alone_can_evaluate_and_ablate():
    code = """
import sys
for name in ("tyro", "rich", "igl", "trimesh"):
    sys.modules[name] = None  # importing it fails
import oasis_warp.evaluation.synthetic
import studies.network_parts
from oasis_warp.synthetic.body import bundled_body
bundled_body()
"""
    paths = os.pathsep.join([str(ROOT), *sys.path])
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "PYTHONPATH": paths})
