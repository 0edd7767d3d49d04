"""A damaged kernel cache heals; the look at values that is part of a call."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import warp as wp

from oasis_kernels.runtime import finite
from oasis_warp.ops._runtime import kernel_cache
from oasis_warp.ops._runtime.kernel_cache import is_damaged, load_module, writable_cache
from oasis_warp.ops._runtime.values import DeferredFiniteCheck, check_finite
from oasis_warp.ops.rasterization import rasterization

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


def test_a_program_that_has_started_warp_leaves_no_kernels_that_later_ones_warn_of(tmp_path):
    """They lay in the folder itself instead of that of Warp's version, and every later process warned of them."""
    call = "import warp; warp.init()\nfrom oasis_warp.ops._runtime.launch import start; start(); print(warp.config."
    called = subprocess.run(
        [sys.executable, "-c", f"{call}kernel_cache_dir)"], env={**os.environ, "OASIS_WARP_CACHE": str(tmp_path)},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert Path(called.stdout.splitlines()[-1]) == tmp_path / wp.config.version


def test_what_a_killed_build_has_left_is_removed_after_an_hour(tmp_path, monkeypatch):
    monkeypatch.setenv("OASIS_WARP_CACHE", str(tmp_path))
    gone = 1 << 23  # more than Linux counts
    kernels = tmp_path / wp.config.version  # where Warp keeps them
    names = (f"wp_a_1_p{gone}_t34", f"wp_b_2_p{gone}_t34", "wp_c_3", f"wp_d_4_p{os.getpid()}_t34")
    old, young, whole, building = (kernels / name for name in names)
    node = tmp_path / f"extension_e_p{gone}_tx7"
    for folder in (old, young, whole, building, node):
        folder.mkdir(parents=True)
        (folder / "a.o").write_bytes(b"half")
    for folder in (old, whole, building, node):
        os.utime(folder, (0, 0))  # the clock has jumped ahead, for the build that goes on
    assert writable_cache() == tmp_path
    assert sorted(path.name for path in kernels.iterdir()) == [young.name, whole.name, building.name]
    assert not node.exists()


POISON = float("nan"), float("inf"), -float("inf"), 1.1e15, -1e30


def arrays(device):
    """More than fit into one launch, of sizes around those of a block, of both types."""
    sizes = [0, 1, 255, 257, finite.CHUNK - 1, finite.CHUNK, finite.CHUNK + 1, 3, 2, 5, 9000, 7]
    g = torch.Generator().manual_seed(0)
    made = {f"array{k}": torch.randn(size, generator=g).to(device) for k, size in enumerate(sizes)}
    assert len(made) > finite.ARRAYS
    return made


def test_every_number_of_every_array_is_looked_at(dtype, device):
    given = {name: tensor.to(dtype) for name, tensor in arrays(device).items()}
    check_finite(nothing=None, **given)
    for k, (name, tensor) in enumerate(given.items()):
        for place in {0, len(tensor) // 2, len(tensor) - 1} if len(tensor) else ():
            kept = tensor[place].item()
            tensor[place] = POISON[(k + place) % len(POISON)]
            with pytest.raises(ValueError, match=f"^{name}: expected finite values .*, got 1 of {len(tensor)} that"):
                check_finite(nothing=None, **given)
            tensor[place] = kept
    check_finite(**given)


def test_the_largest_numbers_allowed_are_allowed(device):
    check_finite(a=torch.tensor([1e15, -1e15], device=device), b=torch.tensor([1e15], device=device).double())


def test_memory_of_any_layout_is_read_as_what_it_stands_for(device):
    wide = torch.full((40, 6), torch.nan, device=device)
    wide[:, ::2] = 1
    check_finite(every_second=wide[:, ::2], transposed=wide[:, ::2].T, repeated=wide[:1, 2].expand(50))
    with pytest.raises(ValueError, match="^transposed: .* got 120 of 240"):
        check_finite(every_second=wide[:, ::2], transposed=wide.T)


@pytest.mark.gpu
def test_a_look_says_at_its_end_what_it_saw_and_leaves_other_errors_alone():
    good, bad = torch.ones(5, device="cuda"), torch.full((5,), torch.nan, device="cuda")
    with DeferredFiniteCheck(good=good, nothing=None):
        pass
    reached = False
    with pytest.raises(ValueError, match="^bad: expected finite values"), DeferredFiniteCheck(good=good, bad=bad):
        reached = True
    assert reached
    with pytest.raises(KeyError), DeferredFiniteCheck(bad=bad):
        raise KeyError
    with DeferredFiniteCheck(good=good), DeferredFiniteCheck(good=good):
        check_finite(good=good)


@pytest.mark.gpu
def test_values_are_not_looked_at_while_a_graph_is_captured():
    values = torch.ones(5, device="cuda")
    check_finite(values=values)  # loads the kernel
    torch.cuda.synchronize()
    with torch.cuda.graph(torch.cuda.CUDAGraph()):
        with pytest.raises(ValueError, match=r"^validate: expected False while a CUDA graph is being captured, got T"):
            check_finite(values=values)
        values.add_(1)  # a graph of nothing would be warned of


def test_a_bad_color_is_refused_before_it_is_drawn(device, as_shipped):
    colors = torch.rand(2, 3, device=device)
    means = torch.tensor([[0.0, 0, 2], [0.1, 0, 2]], device=device)
    K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]], device=device)
    quats, ones = torch.tensor([[1.0, 0, 0, 0]], device=device).expand(2, 4), torch.ones(2, device=device)
    arguments = means, quats, means * 0 + 0.1, ones, colors, torch.eye(4, device=device)[None], K[None], 16, 16
    image = rasterization(*arguments)[0]
    assert torch.equal(rasterization(*arguments, validate=False)[0], image)
    colors[1, 2] = torch.nan
    for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        with pytest.raises(ValueError, match=r"^colors: expected finite values below 1e\+15, got 1 of "):
            rasterization(*arguments, render_mode=mode)
