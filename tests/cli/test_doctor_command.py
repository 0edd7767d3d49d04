"""`oasis doctor`: what it checks, and what it says about faults."""

import tomllib
from pathlib import Path

import pytest
import torch

from oasis_warp.cli import doctor, main
from oasis_warp.network import prior as home

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"


def test_this_installation_is_healthy(capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(doctor.checks())
    assert all(line.startswith("ok ") for line in lines)


def test_a_fault_is_told_with_its_remedy_and_exits_with_one(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "PACKAGES", {"torch": ("99", None), "no-such-package": ("1", "2")})
    monkeypatch.setattr(doctor, "check_networks", lambda: {}["broken"])
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert f'FAIL torch           {torch.__version__}, expected >=99; run `pip install "torch>=99"`' in out
    assert 'FAIL no-such-package not installed; run `pip install "no-such-package>=1,<2"`' in out
    assert "FAIL networks" in out
    assert out.endswith("3 of 12 checks failed.\n")


def test_the_table_of_packages_is_that_of_the_project():
    wanted = {}
    for requirement in tomllib.loads(PYPROJECT.read_text())["project"]["dependencies"]:
        name, _, bounds = requirement.partition(">=")
        low, _, high = bounds.partition(",<")
        wanted[name] = (low, high or None)
    assert doctor.PACKAGES == wanted


@pytest.mark.parametrize(
    ("text", "numbers"),
    [("2.13.0+cpu", (2, 13, 0)), ("5.0.0.93", (5, 0, 0, 93)), ("3", (3,)), ("2.14.0rc1", (2, 14, 0))],
)
def test_versions_are_compared_by_their_numbers(text, numbers):
    assert doctor.parse_version(text) == numbers


def test_a_prior_that_is_missing_is_found(monkeypatch, tmp_path):
    monkeypatch.setattr(home, "asset", lambda *parts: tmp_path / "nothing.safetensors")
    home.bundled_prior.cache_clear()
    with pytest.raises(doctor.FaultError, match="the learned prior is not installed") as caught:
        doctor.check_prior()
    assert caught.value.remedy == "reinstall oasis-warp, or use --prior none"
    home.bundled_prior.cache_clear()


def test_the_newest_version_that_is_not_known_to_work_is_refused(monkeypatch):
    monkeypatch.setattr(doctor.importlib.metadata, "version", lambda name: "2.14.0")
    with pytest.raises(doctor.FaultError, match=r"2\.14\.0, expected >=2\.6,<2\.14"):
        doctor.check_package("torch")


def test_a_second_opencv_is_found(monkeypatch):
    monkeypatch.setattr(doctor, "OTHER_OPENCVS", ("numpy",))
    with pytest.raises(doctor.FaultError, match="numpy is installed too") as caught:
        doctor.check_single_opencv()
    assert "pip uninstall -y numpy" in caught.value.remedy


def test_the_known_gaussian_is_drawn_to_the_last_digits(device):
    assert doctor.gaussian_error(str(device)) <= doctor.TOLERANCE


@pytest.mark.parametrize(
    "slip", [lambda image: image * 0.9999, lambda image: image.roll(1, 1), lambda image: image * torch.nan]
)
def test_a_rasterizer_that_computes_something_else_is_found(monkeypatch, slip):
    import oasis_warp.ops

    right = oasis_warp.ops.rasterization

    def wrong(**arguments):
        image, alpha, meta = right(**arguments)
        return slip(image), alpha, meta

    monkeypatch.setattr(oasis_warp.ops, "rasterization", wrong)
    with pytest.raises(doctor.FaultError, match="a Gaussian is off by"):
        doctor.check_kernels()


def test_a_kernel_cache_that_cannot_be_written_is_found(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("OASIS_WARP_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(doctor.FaultError, match="cannot be written") as caught:
        doctor.check_kernels()
    assert "OASIS_WARP_CACHE" in caught.value.remedy
