"""What ships beside us and what we run with: licences, versions with known faults, and no network."""

import json
import re
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest
import supply
from packaging.requirements import Requirement

from oasis_warp.assets import asset

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
    told, packages = dict(rows), supply.installed()
    ours = {name: package for name, package in packages.items() if not name.startswith(("nvidia", "triton", "cuda"))}
    assert set(ours) <= set(told)
    assert {name: supply.licence(package) for name, package in ours.items()} == {name: told[name] for name in ours}


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
from oasis_warp.cli import main
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
