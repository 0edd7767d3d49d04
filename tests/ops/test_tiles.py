"""Lists of the Gaussians of each tile."""

import pytest
import torch
from projection_runs import OPTIONS
from rasterization_scenes import intrinsics, stiff_scene

from oasis_warp.ops._runtime.tiles import MAX_PAIRS, bin_to_tiles, opaque_elements
from oasis_warp.ops.projection import project


@pytest.mark.slow
def test_more_pairs_than_can_be_counted_are_refused_with_their_number():
    n, size = 2**19 + 1, 64
    K, eye = intrinsics(50.0, 50.0, 32.0, 32.0).float()[None], torch.eye(4)[None]
    means = torch.zeros(n, 3)
    means[:, 2] = 2
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    projection = project(means, quats, torch.full((n, 3), 9.0), torch.full((n,), 0.5), eye, K, size, size, **OPTIONS)
    with pytest.raises(ValueError, match=f"at most {MAX_PAIRS} pairs of a Gaussian and a tile, got {n * 4096}"):
        bin_to_tiles(projection.tables().boxes, projection.tables().sort_depths, size, size, 1)


@pytest.mark.parametrize("name", ["larger than the image", "thousands of faint layers", "partly behind the camera"])
def test_lists_hold_each_tiles_gaussians_by_depth_and_then_by_index(name):
    scene = stiff_scene(name, 60)
    scene = scene.with_(means=torch.cat([scene.means, scene.means]))  # every depth is there twice
    twice = [torch.cat([t, t]) for t in scene.gaussians[1:]]
    cameras, Ks = scene.viewmats.repeat(2, 1, 1), scene.Ks.repeat(2, 1, 1)
    records = project(scene.means, *twice, cameras, Ks, scene.width, scene.height, **OPTIONS).tables()
    lists = bin_to_tiles(records.boxes, records.sort_depths, scene.width, scene.height, 7)
    gaussians, pairs = opaque_elements(lists.gaussians).long(), opaque_elements(lists.pairs)
    depths, n = records.sort_depths.view(-1), len(scene.means)
    x0, y0, x1, y1 = records.boxes.view(-1, 4).unbind(1)
    for tile in range(2 * lists.across * lists.down):
        camera, place = divmod(tile, lists.across * lists.down)
        top, left = place // lists.across * 7, place % lists.across * 7
        inside = (x0 < x1) & (y0 < y1) & (x1 > left) & (x0 < left + 7) & (y1 > top) & (y0 < top + 7)
        members = (inside & (torch.arange(2 * n) // n == camera)).nonzero()[:, 0]
        expected = members[torch.argsort(depths[members], stable=True)]
        assert torch.equal(gaussians[lists.starts[tile] : lists.starts[tile + 1]], expected)
    # A pair's number is its Gaussian's first plus its place among that Gaussian's tiles.
    place = pairs - lists.pair_starts[gaussians]
    assert place.min() >= 0 and (place < lists.pair_counts[gaussians]).all()
    assert torch.equal(pairs.sort().values, torch.arange(len(pairs)))
