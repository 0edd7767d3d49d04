"""A damaged kernel cache heals, and one that cannot be written costs a warning."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from oasis_warp.ops._runtime import kernel_cache
from oasis_warp.ops._runtime.kernel_cache import is_damaged, load_module, writable_cache

CALL = """
import torch
from oasis_warp.ops import spherical_harmonics
torch.manual_seed(0)
print(spherical_harmonics(1, torch.randn(9, 3), torch.randn(9, 4, 3)).double().sum().item())
"""


class FakeModule:
    """As Warp's: builds what is not there, and loads only what it has built itself."""

    name = "fake"

    def __init__(self):
        self.failed_builds, self.builds = {}, 0

    def get_module_identifier(self, block_dim):
        return "wp_fake"

    def load(self, device, block_dim):
        folder = Path(wp.config.kernel_cache_dir) / "wp_fake"
        if not (folder / "a.o").is_file():
            folder.mkdir(exist_ok=True)
            (folder / "a.o").write_bytes(b"machine code")
            (folder / "a.meta").write_text("{}")
            self.builds += 1
        if not (folder / "a.meta").read_text():
            raise ValueError("no JSON")
        return (folder / "a.o").read_bytes()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    load_module(FakeModule(), None, 1)
    return tmp_path / "wp_fake"


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("damage", [
    lambda folder: flip(folder / "a.o"),
    lambda folder: (folder / "a.o").write_bytes(b""),
    lambda folder: (folder / "a.meta").write_text(""),
    lambda folder: flip(folder / kernel_cache.DIGESTS),
    lambda folder: [(folder / kernel_cache.DIGESTS).unlink(), (folder / "a.meta").write_text("")],
], ids=["flipped bit", "empty object", "empty meta", "damaged digests", "empty meta without digests"])  # fmt: skip
def test_a_damaged_module_is_built_once_more_and_then_stays(cache, damage):
    damage(cache)
    again, then = FakeModule(), FakeModule()
    load_module(again, None, 1)
    load_module(then, None, 1)
    assert (again.builds, then.builds) == (1, 0)
    assert (cache / "a.o").read_bytes() == b"machine code" and not is_damaged(cache)


def test_an_object_of_another_processor_beside_it_is_no_damage(cache):
    (cache / "a.cpu2.o").write_bytes(b"other code")
    module = FakeModule()
    load_module(module, None, 1)
    assert module.builds == 0 and (cache / "a.cpu2.o").is_file()


def test_where_the_cache_cannot_be_written_a_temporary_folder_is_used_and_said(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("OASIS_WARP_CACHE", str(tmp_path / "file"))
    with pytest.warns(RuntimeWarning, match="the kernel cache cannot be used .*file.*Set OASIS_WARP_CACHE"):
        folder = writable_cache()
    (folder / "kernel").touch()


@pytest.mark.slow
def test_flipped_bits_in_a_real_cache_are_found_and_built_anew(tmp_path):
    def run():
        called = subprocess.run(
            [sys.executable, "-c", CALL], env={**os.environ, "OASIS_WARP_CACHE": str(tmp_path)}, check=True,
            capture_output=True, text=True,
        )  # fmt: skip
        return called.stdout

    right, objects = run(), sorted(tmp_path.rglob("*.o"))
    before = [path.read_bytes() for path in objects]
    for path in objects:
        flip(path)
    assert run() == right
    assert [path.read_bytes() for path in objects] == before


def test_what_a_killed_build_has_left_is_removed_after_an_hour(tmp_path, monkeypatch):
    monkeypatch.setenv("OASIS_WARP_CACHE", str(tmp_path))
    gone = 1 << 23  # more than Linux counts
    names = (f"wp_a_1_p{gone}_t34", f"wp_b_2_p{gone}_t34", "wp_c_3", f"wp_d_4_p{os.getpid()}_t34")
    old, young, whole, building = (tmp_path / name for name in names)
    for folder in (old, young, whole, building):
        folder.mkdir()
        (folder / "a.o").write_bytes(b"half")
    for folder in (old, whole, building):
        os.utime(folder, (0, 0))  # the clock has jumped ahead, for the build that goes on
    assert writable_cache() == tmp_path
    assert sorted(path.name for path in tmp_path.iterdir()) == [young.name, whole.name, building.name]
