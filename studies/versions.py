"""Which versions of Python and torch this runs with: each is installed, and makes an avatar and runs tests there.

Fills docs/troubleshooting.md (versions). Every case is a new environment in a temporary folder, with the newest other
packages that pip finds; `pythonX.Y` must be found on PATH. Versions of torch outside our own bounds are tried as well.
"""

import json
import os
import re
import subprocess
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement

from studies.harness import Row, StudyOptions, measured
from studies.tables import Column, Section, table

TOP = Path(__file__).parents[1]
PHOTO = TOP / "src" / "oasis_warp" / "assets" / "photos" / "palm_open_left_02.png"
TESTS = ("tests/ops/test_operator_laws.py", "tests/ops/test_rasterization.py", "tests/ops/test_face_rotations.py",
         "tests/render", "tests/test_hand_avatar.py", "tests/data_stage/test_avatar_file.py")  # fmt: skip
FOR_TESTS = ("pytest", "pytest-timeout", "pytest-xdist", "beartype")
SHOWN = ("torch", "warp-lang", "numpy", "scipy", "opencv-contrib-python-headless")
PATIENCE = 800
"""Seconds for each step."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting = frozenset({"pythons", "torches"})

    pythons: tuple[str, ...] = ("3.11", "3.12", "3.13")
    torches: tuple[str, ...] = ("2.6.0", "2.13.0")


def others() -> list[str]:
    """What the package needs but torch, which comes first, in the version that is tried."""
    with (TOP / "pyproject.toml").open("rb") as file:
        needed = tomllib.load(file)["project"]["dependencies"]
    return [line for line in needed if Requirement(line).name != "torch"]


def measure_versions(python: str, torch: str) -> Row:
    """Install, look, make an avatar and run tests; a step that fails is told by a line of its own, and ends the case.

    What `oasis doctor` finds ends nothing: it refuses versions outside our bounds.
    """
    row: Row = {"python": python}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        here = {**os.environ, "OASIS_WARP_CACHE": str(folder / "kernels"), "OMP_NUM_THREADS": "1"}
        here.pop("PYTHONPATH", None)
        own = str(folder / "venv" / "bin" / "python")
        pip = [own, "-m", "pip", "install", "-q", "--no-cache-dir"]
        make = [own, "-m", "oasis_warp", "reconstruct", str(PHOTO), "-o", str(folder / "out")]
        tests = [own, "-m", "pytest", "-q", "-o", "addopts=--jaxtyping-packages=oasis_warp,lazy_beartype.checked",
                 "-p", "no:cacheprovider", *TESTS]  # fmt: skip
        steps = {
            "installed": [[f"python{python}", "-m", "venv", str(folder / "venv")],
                          [*pip, f"torch=={torch}", *others(), *FOR_TESTS], [*pip, "--no-deps", "-e", str(TOP)]],
            "doctor": [[own, "-m", "oasis_warp", "doctor"]], "avatar": [make], "tests": [tests],
        }  # fmt: skip
        for step, commands in steps.items():
            for command in commands:
                done = subprocess.run(command, capture_output=True, text=True, env=here, cwd=TOP, timeout=PATIENCE)
                if done.returncode:
                    break
            lines = [line for line in (done.stdout + "\n" + done.stderr).splitlines() if line.strip()] or [""]
            wrong = next((line for line in lines if line.startswith("FAIL ")), lines[-1])
            said = " ".join(wrong.removeprefix("FAIL").split(";")[0].split())[:150]
            row[step] = "yes" if done.returncode == 0 else f"no: {said}"
            if step == "tests" and (counts := re.findall(r"\d+ (?:passed|failed|error)", "\n".join(lines[-3:]))):
                row[step] = ", ".join(counts)
            if done.returncode:
                row["said"] = "\n".join(lines[-30:])
                if step != "doctor":
                    break
            if step == "installed":
                row |= installed(own)
    return row


def installed(python: str) -> dict[str, str]:
    """Versions of the packages that matter in an environment."""
    code = f"import json; from importlib.metadata import version; print(json.dumps([version(n) for n in {SHOWN}]))"
    output = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True, cwd="/").stdout
    return dict(zip(SHOWN, json.loads(output), strict=True))


def run(options: Options) -> list[Row]:
    """Try every pair of versions."""
    cases = {f"Python {python}, torch {torch}": (python, torch)
             for torch in options.torches for python in options.pythons}  # fmt: skip
    return measured("versions", cases, measure_versions, options)


COLUMNS = (
    Column("Python", "python"), Column("torch", "torch"), Column("Warp", "warp-lang"), Column("NumPy", "numpy"),
    Column("OpenCV", "opencv-contrib-python-headless"), Column("installs", "installed"), Column("doctor", "doctor"),
    Column("photo to avatar", "avatar"), Column("tests", "tests"),
)  # fmt: skip
SECTIONS = (Section("troubleshooting.md", "versions", table(COLUMNS)),)
