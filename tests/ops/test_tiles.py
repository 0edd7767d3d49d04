"""Lists of the Gaussians of each tile, by either of two ways."""

import pytest
import torch
from projection_runs import OPTIONS
from rasterization_scenes import intrinsics, stiff_scene

from oasis_warp.ops._runtime.tiles import MAX_PAIRS, bin_by_dealing, bin_by_sorting, bin_to_tiles, opaque_elements
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
def test_dealing_and_sorting_fill_the_same_lists(name):
    scene = stiff_scene(name, 300)
    scene = scene.with_(means=torch.cat([scene.means, scene.means]))  # every depth is there twice
    twice = [torch.cat([t, t]) for t in scene.gaussians[1:]]
    cameras, Ks = scene.viewmats.repeat(2, 1, 1), scene.Ks.repeat(2, 1, 1)
    projection = project(scene.means, *twice, cameras, Ks, scene.width, scene.height, **OPTIONS)
    records = projection.tables()
    dealt, sorted_ = (f(records.boxes, records.sort_depths, 7, 10, 10) for f in (bin_by_dealing, bin_by_sorting))
    assert torch.equal(dealt.starts, sorted_.starts)
    assert torch.equal(opaque_elements(dealt.gaussians), opaque_elements(sorted_.gaussians))
    assert torch.equal(dealt.pair_counts, sorted_.pair_counts)
    for lists in (dealt, sorted_):
        gaussians, pairs = opaque_elements(lists.gaussians), opaque_elements(lists.pairs)
        # A pair's number is its Gaussian's first plus its place among that Gaussian's tiles.
        first = lists.pair_starts[gaussians.long()]
        place = pairs - first
        assert place.min() >= 0 and (place < lists.pair_counts[gaussians.long()]).all()
        assert torch.equal(pairs.sort().values, torch.arange(len(pairs)))
