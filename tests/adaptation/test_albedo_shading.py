"""Of what a photo shows beyond the guess, shade goes when the hand turns and marks stay."""

import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation.sh_lighting import STAYS, marks, split_albedo_shading
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.pose import factors, posed_normals
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.types import HandLight

SHADOW = (0.55, 0.4, 0.3)
"""Factors of a colour: shadows on skin are red."""
INK, POLISH, HALF_INK = (0.19, 0.25, 0.36), (1.0, 0.22, 0.37), (0.6, 0.67, 0.74)


@pytest.fixture(scope="module")
def scene(hand):
    crop, _, _ = crop_of(hand, region_colors(label_regions(hand), 0.03), size=48)
    guess = MeanPrior(hand)(crop)
    guess = guess._replace(colors=0.6 * guess.colors)
    facing = posed_normals(crop.rest.vertices, crop.posed.vertices, hand.faces)
    harmonics = torch.tensor([[1.0, 0.9, 0.8], [0.1, 0.1, 0.1], [-0.2, -0.2, -0.2], [-0.1, -0.1, -0.1]])
    limits = torch.stack([torch.full((3,), 0.3), torch.full((3,), 1.5)])
    return guess, HandLight(harmonics, limits, torch.ones(3), facing=facing)


def learned_on(hand, guess, factor):
    """The guess, but for one half of the hand."""
    half = (hand.template[:, :1] < hand.template[:, 0].median()).float()
    where = vertex_to_gaussians(half, hand.faces, guess).round()
    colors = (guess.colors * (1 + where * (torch.tensor(factor) - 1))).clamp(0.01, 1)
    return guess._replace(colors=colors), where[:, 0] > 0


@pytest.mark.parametrize("factor", [SHADOW, INK, POLISH, (1.2, 1.25, 1.3)])
def test_the_photo_s_own_view_stays_as_it_is(hand, scene, factor):
    guess, light = scene
    learned, _ = learned_on(hand, guess, factor)
    parted = split_albedo_shading(hand, guess.colors, learned)
    before = learned.colors * factors(learned, hand.faces, light, light.facing)
    after = parted.colors * factors(parted, hand.faces, light, light.facing)
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)


def test_a_shadow_goes_and_marks_stay(hand, scene):
    guess, _ = scene

    def share_that_stays(factor):
        learned, there = learned_on(hand, guess, factor)
        parted = split_albedo_shading(hand, guess.colors, learned)
        there = there & (learned.colors > 0.03).all(1)
        before, after = ((g.colors / guess.colors).log()[there] for g in (learned, parted))
        return float(after.norm() / before.norm())

    assert share_that_stays(SHADOW) == pytest.approx(STAYS, abs=0.02)
    assert share_that_stays(HALF_INK) > 0.4
    assert share_that_stays(INK) > 0.95 and share_that_stays(POLISH) > 0.95  # but for faces at the border


def test_what_is_finer_than_the_vertices_is_shade_too(hand, scene):
    guess, _ = scene
    n_vertices = len(guess.vertex_index)
    colors = guess.colors.clone()
    colors[n_vertices::2] *= 0.8
    parted = split_albedo_shading(hand, guess.colors, guess._replace(colors=colors))
    left = (parted.colors / guess.colors).log()[n_vertices::2]
    torch.testing.assert_close(left, torch.full_like(left, STAYS).mul(torch.tensor(0.8).log()), atol=1e-4, rtol=0)


def test_what_was_not_learned_does_not_change(hand, scene):
    guess, _ = scene
    parted = split_albedo_shading(hand, guess.colors, guess)
    torch.testing.assert_close(parted.colors, guess.colors)
    assert parted.shade is not None
    torch.testing.assert_close(parted.shade, torch.ones_like(parted.shade))


def test_marks_are_told_from_light_by_what_lies_across():
    line = torch.tensor([[0.364, 0.574, 0.734]])  # from dark and red to bright and pale
    assert float(marks(-2 * line)) < 0.05 and float(marks(0.5 * line)) < 0.05
    assert float(marks(torch.tensor([[-1.0, -0.6, -0.1]]))) == 1
    assert float(marks(torch.tensor([[0.65, 0.75, 0.85]]))) == 1  # white paint on skin that is not pale
    assert float(marks(torch.zeros(1, 3))) == 0


def test_ink_on_single_gaussians_is_no_mark(hand, scene):
    guess, _ = scene
    n_vertices = len(guess.vertex_index)
    colors = guess.colors.clone()
    colors[n_vertices::2] *= torch.tensor(INK)
    learned = guess._replace(colors=colors.clamp_min(0.03))
    parted = split_albedo_shading(hand, guess.colors, learned)
    clear = (learned.colors > 0.031).all(1)
    clear[:n_vertices] = False
    ratio = ((parted.colors / guess.colors).log().norm(dim=1) / (learned.colors / guess.colors).log().norm(dim=1))
    there = clear & (torch.arange(len(clear)) % 2 == n_vertices % 2)
    assert int(there.sum()) > 100
    assert ratio[there].max() < STAYS + 0.1
