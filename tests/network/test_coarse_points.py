"""The coarse set of points that the refinement works on."""

import pytest
import torch

from oasis_warp.core import surface
from oasis_warp.network.refinement import CoarseLevel, Refinement, place_coarse_points, to_coarse, to_fine


@pytest.fixture(scope="module")
def points(hand):
    return place_coarse_points(hand, 1024)


def test_points_are_spread_evenly(hand, points):
    places = hand.template[points.index]
    assert len(points.index.unique()) == 1024
    to_nearest = torch.cdist(hand.template, places).amin(1)
    assert float(to_nearest.max()) < 0.006
    assert 0.001 < float(to_nearest.mean()) < 0.003


def test_a_constant_field_survives_both_ways(points, hand):
    fine = torch.full((2, len(hand.template), 3), 0.3)
    coarse = to_coarse(fine, points.pool)
    torch.testing.assert_close(coarse, torch.full((2, 1024, 3), 0.3))
    torch.testing.assert_close(to_fine(coarse, points.blend, points.weights), fine)


def test_a_smooth_field_comes_back_nearly_as_it_went(points, hand):
    field = hand.template[None] / 0.01
    back = to_fine(to_coarse(field, points.pool), points.blend, points.weights)
    assert float((back - field).norm(dim=-1).mean()) < 0.2  # 2 mm


def test_neither_the_other_side_nor_another_finger_is_read(hand, points):
    normals = surface.vertex_normals(hand.template, hand.faces)
    read = points.index[points.blend]
    facing = (normals[read] * normals[:, None]).sum(-1)
    assert float((facing > 0).float().mean()) > 0.995
    finger = torch.where(hand.segment == 0, 0, (hand.segment + 2) // 3)
    other = (finger[read] != finger[:, None]) & (finger[read] > 0) & (finger[:, None] > 0)
    # at the webs fingers meet; away from them none is blended with its neighbour
    tips = (hand.segment > 0) & ((hand.segment - 1) % 3 == 2)
    assert not bool(other[tips].any())
    assert float(other.float().mean()) < 0.01


def test_the_same_hand_gets_the_same_points(hand, points):
    assert all(torch.equal(a, b) for a, b in zip(points, place_coarse_points(hand, 1024), strict=True))


def test_more_points_than_vertices_are_refused(hand):
    with pytest.raises(ValueError, match="n_coarse: expected at most 12337, the vertices of the hand, got 12338"):
        place_coarse_points(hand, 12_338)


def test_refinement_passes_on_what_changed_at_coarse_points(hand, random):
    torch.manual_seed(0)
    level, refinement = CoarseLevel(hand, 64), Refinement(16, 2, 1)
    x = torch.randn(1, len(hand.template), 16, generator=random)
    out = refinement(x, level)
    coarse = level.down(x)
    torch.testing.assert_close(out - x, level.up(refinement.blocks(coarse) - coarse), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(refinement(coarse, None), refinement.blocks(coarse))
    assert not list(level.parameters()) and not level.state_dict()
