"""The vector kernels of the CPU against the generic ones they stand in for, and these with CUDA's share of work."""

import pytest
import torch
from rasterization_scenes import ordinary_scene
from test_rasterization import INPUTS, draw, rel, values_and_gradients
from test_rasterization_stiff import CASES

from oasis_warp.ops import blending
from oasis_warp.ops._launch import SCALAR

# Another order of the sums over a pair's pixels; random signs cancel in them.
REORDERED = 2e-5


def both_ways(scene, monkeypatch, **options):
    rows = values_and_gradients(scene, **options)
    with monkeypatch.context() as patch:
        patch.setattr(
            blending, "blend_kernel", lambda like, n: blending.forward_kernels.blend(SCALAR[like.dtype], n)
        )
        patch.setattr(
            blending,
            "blend_backward_kernel",
            lambda like, n: blending.backward_kernels.blend_backward(SCALAR[like.dtype], n),
        )
        return rows, values_and_gradients(scene, **options)


def assert_same(rows, generic):
    assert torch.equal(rows[0], generic[0]), "image"
    assert torch.equal(rows[1], generic[1]), "alphas"
    for name, a, b in zip(INPUTS, rows[2], generic[2], strict=True):
        assert rel(a, b.double()) <= REORDERED, name


@pytest.mark.parametrize("tile_size", [1, 7, 16, 17, 40])
def test_rows_draw_the_same_bits_as_single_pixels(tile_size, monkeypatch):
    assert_same(*both_ways(ordinary_scene(1, n=200), monkeypatch, tile_size=tile_size))


@pytest.mark.parametrize("channels", [1, 4, 32])
def test_rows_of_any_channel_count_draw_the_same_bits(channels, monkeypatch):
    assert_same(*both_ways(ordinary_scene(2, channels=channels), monkeypatch))


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (15, 31), (33, 2)])
def test_rows_that_end_in_mid_vector_draw_the_same_bits(size, monkeypatch):
    assert_same(*both_ways(ordinary_scene(3, width=size[0], height=size[1]), monkeypatch))


@pytest.mark.parametrize("name", ["opaque stack", "3000 faint layers", "larger than the image", "at the near plane"])
def test_rows_of_stiff_scenes_draw_the_same_bits(name, monkeypatch):
    assert_same(*both_ways(CASES[name][0].to(torch.float32), monkeypatch))


@pytest.mark.parametrize("tile_size", [1, 5, 16, 20])
@pytest.mark.parametrize("grid", [blending.CUDA_LANES, blending.CUDA_WARP_LANES])
def test_lanes_share_a_tile_without_gap_or_overlap(tile_size, grid, monkeypatch):
    scene = ordinary_scene(4, n=100, dtype=torch.float64)  # float64: the generic kernel, which also runs on CUDA
    alone = draw(scene, tile_size=tile_size)
    cuda, lane_grid = torch.device("cuda"), blending.lane_grid
    monkeypatch.setattr(blending, "lane_grid", lambda size, *_: lane_grid(size, cuda, grid))
    shared = draw(scene, tile_size=tile_size)
    assert torch.equal(alone[0], shared[0]) and torch.equal(alone[1], shared[1])
