"""What users import, what is imported for what, and what ships beside us: licences, safe versions, no network."""

import importlib
import json
import os
import re
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest
import supply
from packaging.requirements import Requirement

import oasis_warp
from oasis_warp.assets import asset


@pytest.mark.parametrize("name", oasis_warp.__all__)
def test_every_public_name_has_a_home_and_a_docstring(name):
    assert getattr(oasis_warp, name).__doc__
    assert name in dir(oasis_warp)


def test_the_list_of_names_is_the_table_of_homes():
    assert sorted(oasis_warp.__all__) == sorted(oasis_warp._HOMES)


def test_every_name_of_the_api_reference_is_in_the_module_that_it_is_attributed_to():
    """`watch_overflow` was listed in `oasis_warp.ops`, but was only in a private module."""
    text = (Path(__file__).parents[1] / "docs" / "api.md").read_text()
    names = re.findall(r"^\.\. auto(?:function|class|exception|data):: ([\w.]+)$", text, re.MULTILINE)
    for module, members in re.findall(r"^\.\. automodule:: ([\w.]+)\n   :members: (.+)$", text, re.MULTILINE):
        names += [f"{module}.{member}" for member in members.split(", ")]
    homes = [name.rpartition(".")[::2] for name in names]
    assert [name for module, name in homes if not hasattr(importlib.import_module(module), name)] == []
    assert {name for module, name in homes if module == "oasis_warp"} == set(oasis_warp.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = oasis_warp.no_such_name


def test_importing_the_package_loads_neither_torch_nor_warp():
    code = "import sys, oasis_warp; sys.exit(any(m in sys.modules for m in ('torch', 'warp', 'cv2')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


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


TOP = Path(__file__).parents[1]


def test_no_copyleft_part_of_libigl_is_imported():
    """Its wheel ships GPL binaries beside its MPL core."""
    assert "igl.copyleft" in (TOP / "NOTICE").read_text()
    places = ("src", "kernels", "tests", "studies", "asset_build", "examples")
    files = [file for place in places for file in (TOP / place).rglob("*.py") if file != Path(__file__)]
    assert len(files) > 100
    using = {str(file.relative_to(TOP)) for file in files if re.search(r"\bigl\b", file.read_text())}
    assert not [name for name in using if re.search(r"copyleft|tetgen|cgal", (TOP / name).read_text())]
    assert not [name for name in using if name.startswith(("src", "kernels"))]


def test_the_bill_of_materials_names_all_that_runs_and_is_the_same_each_time():
    bill = supply.bill_of_materials()
    assert json.dumps(bill) == json.dumps(supply.bill_of_materials()) and "timestamp" not in json.dumps(bill)
    names = {component["name"] for component in bill["components"]}
    declared = re.search(r"\ndependencies = \[(.*?)\n\]", (TOP / "pyproject.toml").read_text(), re.DOTALL)
    assert declared is not None
    assert {Requirement(line).name for line in re.findall(r'^  "(.*?)"', declared[1], re.MULTILINE)} <= names
    assert {ref["ref"] for ref in bill["dependencies"]} >= {component["bom-ref"] for component in bill["components"]}
    bundled = [part for component in bill["components"] for part in component.get("components", ())]
    assert all(len(part["hashes"][0]["content"]) == 64 for part in bundled)


def test_the_licences_of_the_page_are_those_of_the_installed_packages():
    rows = re.findall(r"^\| ([a-z0-9-]+) \| (.+) \|$", (TOP / "docs" / "security.md").read_text(), re.MULTILINE)
    listed, packages = dict(rows), supply.installed()
    ours = {name: package for name, package in packages.items() if not name.startswith(("nvidia", "triton", "cuda"))}
    assert set(ours) <= set(listed)
    assert {name: supply.licence(package) for name, package in ours.items()} == {name: listed[name] for name in ours}


def test_versions_with_known_faults_are_found_in_packages_and_in_what_their_wheels_bundle():
    known = json.loads(supply.KNOWN.read_text())["vulnerabilities"]
    assert all(one.keys() >= {"id", "package", "about"} for one in known)
    components = [
        {"name": "torch", "version": "2.5.1+cpu"}, {"name": "jinja2", "version": "3.1.6"},
        {"name": "opencv", "version": "5.0", "components": [{"name": "libcrypto", "version": "1.1.1k"}]},
    ]  # fmt: skip
    found = {one["id"] for one in supply.affected(components, known)}
    assert {"CVE-2025-32434", "CVE-2021-3711"} <= found and not {"CVE-2025-27516"} & found
    assert supply.check() == 0


OFFLINE = """
import sys

def deny(event, arguments):
    if event.startswith(("socket.", "urllib.", "ftplib.", "http.")):
        raise SystemExit(f"network: {event} {arguments}")

sys.addaudithook(deny)
from oasis_warp.cli import main, reconstruct
reconstruct.TURNTABLE_FRAMES = 2
photo, out = sys.argv[1:]
assert main(["reconstruct", photo, "-o", out, "--size", "64", "--steps", "2"]) == 0
avatar = f"{out}/avatar.safetensors"
for command in (["render", avatar, "-o", f"{out}/a.png"], ["export", avatar, "-o", f"{out}/a.html"], ["info", avatar]):
    assert main(command) == 0
print("done")
"""


@pytest.mark.slow
def test_a_photo_becomes_an_avatar_where_every_socket_is_denied(tmp_path):
    with resources.as_file(asset("photos", "palm_open_left_02.png")) as photo:
        command = [sys.executable, "-c", OFFLINE, str(photo), str(tmp_path / "out")]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.stdout.endswith("done\n"), ran.stderr
