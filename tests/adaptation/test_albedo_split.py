"""The split of what a photo shows into albedo and shade."""

import math

import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation.albedo_split import (
    ALBEDO_SHARE,
    DARKEST_FINE,
    FINE_SHARE,
    MOST_HUE,
    mark_probability,
    split_albedo_shading,
)
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.pose import shading_factors
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.avatar.vertex_light import Lighting, posed_lighting
from oasis_warp.core.types import HandLight

SHADOW = (0.55, 0.4, 0.3)
"""Factors of a colour: shadows on skin are red."""
INK, POLISH, HALF_INK = (0.19, 0.25, 0.36), (1.0, 0.22, 0.37), (0.6, 0.67, 0.74)


@pytest.fixture(scope="module")
def albedo_scene(hand):
    crop, _, _ = crop_of(hand, region_colors(label_regions(hand), 0.03), size=48)
    guess = MeanPrior(hand)(crop)
    guess = guess._replace(colors=0.6 * guess.colors)
    harmonics = torch.tensor([[1.0, 0.9, 0.8], [0.1, 0.1, 0.1], [-0.2, -0.2, -0.2], [-0.1, -0.1, -0.1]])
    limits = torch.stack([torch.full((3,), 0.3), torch.full((3,), 1.5)])
    light = HandLight(harmonics, limits, torch.ones(3))
    facing = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, light).normals
    return guess, light._replace(facing=facing)


def learned_on(hand, guess, factor):
    """The guess, but for one half of the hand."""
    half = (hand.template[:, :1] < hand.template[:, 0].median()).float()
    where = vertex_to_gaussians(half, hand.faces, guess).round()
    colors = (guess.colors * (1 + where * (torch.tensor(factor) - 1))).clamp(0.01, 1)
    return guess._replace(colors=colors), where[:, 0] > 0


@pytest.mark.parametrize("factor", [SHADOW, INK, POLISH, (1.2, 1.25, 1.3)])
def test_the_photo_s_own_view_stays_as_it_is(hand, albedo_scene, factor):
    guess, light = albedo_scene
    learned, _ = learned_on(hand, guess, factor)
    parted = split_albedo_shading(hand, guess.colors, learned)
    before = learned.colors * shading_factors(learned, hand.faces, light, Lighting(light.facing, None))
    after = parted.colors * shading_factors(parted, hand.faces, light, Lighting(light.facing, None))
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)


def test_a_shadow_goes_and_marks_stay(hand, albedo_scene):
    guess, _ = albedo_scene
    border = hand.template[:, 0].median()
    inner = vertex_to_gaussians((hand.template[:, :1] < border - 0.03).float(), hand.faces, guess)[:, 0] == 1

    def share_that_stays(factor, where=True):
        learned, there = learned_on(hand, guess, factor)
        parted = split_albedo_shading(hand, guess.colors, learned)
        there = there & (learned.colors > 0.03).all(1) & where
        before, after = ((g.colors / guess.colors).log()[there] for g in (learned, parted))
        return float(after.norm() / before.norm())

    assert share_that_stays((0.8, 0.7, 0.6), inner) == pytest.approx(ALBEDO_SHARE, abs=0.03)  # its border is fine
    assert share_that_stays(SHADOW, inner) < 0.01  # too dark for skin
    assert share_that_stays(HALF_INK) > 0.4
    assert share_that_stays(INK) > 0.95 and share_that_stays(POLISH) > 0.95  # but for faces at the border


def test_creases_stay(hand, albedo_scene):
    """Faded with the rest, nails and knuckles were gone as soon as a finger bent."""
    guess, _ = albedo_scene
    lines = (torch.sin(hand.template[:, :1] * 2 * math.pi / 0.004)).sign()
    colors = guess.colors * (0.1 * vertex_to_gaussians(lines, hand.faces, guess)).exp()
    parted = split_albedo_shading(hand, guess.colors, guess._replace(colors=colors))
    before, after = (vertex_colors(guess._replace(colors=(c / guess.colors).log()), len(lines)) for c in
                     (colors, parted.colors))  # fmt: skip
    assert 0.9 < float((before * after).sum() / before.square().sum()) / FINE_SHARE < 1.05


def test_what_is_finer_than_the_vertices_stays(hand, albedo_scene):
    """Read at vertices only, what is finer was shade, and went when a finger bent."""
    guess, _ = albedo_scene
    n_vertices = len(guess.vertex_index)
    colors = guess.colors.clone()
    colors[n_vertices::2] *= 0.9
    parted = split_albedo_shading(hand, guess.colors, guess._replace(colors=colors))
    left = (parted.colors / guess.colors).log()[n_vertices::2] / math.log(0.9)
    assert float(left.min()) > 0.85


def test_dark_folds_keep_no_other_hue(hand, albedo_scene):
    """Folds of a squeezed palm are red, and were gashes in the opened one."""
    guess, _ = albedo_scene
    lines = (torch.sin(hand.template[:, :1] * 2 * math.pi / 0.01) > 0.7).float()
    fold = torch.tensor([-0.05, -0.3, -0.4])
    colors = guess.colors * (vertex_to_gaussians(lines, hand.faces, guess) * fold).exp()
    parted = split_albedo_shading(hand, guess.colors, guess._replace(colors=colors))
    left = (parted.colors / guess.colors).log()[colors[:, 2] < 0.7 * guess.colors[:, 2]]
    hue = (left - left.mean(1, keepdim=True)).abs()
    assert float(hue.max()) < MOST_HUE + ALBEDO_SHARE * 0.2 + 0.02
    assert float(left.mean()) < -0.1  # they are still lines


def test_wide_folds_do_not_stay_where_the_hand_turns_into_the_arm(hand, albedo_scene):
    """A bright fold at the root of the arm was a yellow smear in every pose."""
    guess, _ = albedo_scene
    bands = torch.sin(hand.template[:, :1] * 2 * math.pi / 0.03)
    learned = guess._replace(colors=guess.colors * (0.1 * vertex_to_gaussians(bands, hand.faces, guess)).exp())

    def left(hand_share):
        parted = split_albedo_shading(hand, guess.colors, learned, hand_share=torch.full((len(bands),), hand_share))
        return float((parted.colors / guess.colors).log().norm() / (learned.colors / guess.colors).log().norm())

    assert left(0.0) < 0.75 * left(1.0)


def test_shade_leaves_no_line_where_what_the_photo_shows_ends(hand, albedo_scene):
    """Skin on a slant was a dark patch with a hard edge, as what the photo did not show counted as lit."""
    guess, _ = albedo_scene
    seen = (hand.template[:, 0] < hand.template[:, 0].median()).float()
    shown = vertex_to_gaussians(seen[:, None], hand.faces, guess)
    learned = guess._replace(colors=guess.colors * (shown * torch.tensor([-0.25, -0.3, -0.35])).exp())

    def left(weights):
        parted = split_albedo_shading(hand, guess.colors, learned, seen=weights)
        return (parted.colors / guess.colors).log().mean(1)[(shown[:, 0] == 1) & (learned.colors > 0.03).all(1)]

    assert float(left(seen.clamp_min(0.02)).min()) == pytest.approx(-0.3 * ALBEDO_SHARE, abs=0.04)
    assert float(left(None).min()) < -0.15


def test_skin_that_gets_darker_up_to_where_the_photo_ends_keeps_no_dark_edge(hand, albedo_scene):
    """Its mean was one of brighter skin only, and the last centimetre was a dark patch with a hard edge."""
    guess, _ = albedo_scene
    before_end = (hand.template[:, 0].median() - hand.template[:, 0]) / 0.02
    seen = (before_end > 0).float()
    shown = vertex_to_gaussians((seen * (1 - before_end).clamp(0, 1))[:, None], hand.faces, guess)
    learned = guess._replace(colors=guess.colors * (-0.4 * shown).exp())
    parted = split_albedo_shading(hand, guess.colors, learned, seen=seen.clamp_min(0.02))
    left = (parted.colors / guess.colors).log().mean(1)[(shown[:, 0] > 0.9) & (learned.colors > 0.03).all(1)]
    assert float(left.mean()) > -0.15  # -0.18 with a mean; ALBEDO_SHARE alone leaves -0.08


def test_what_is_wide_leaves_the_albedo_where_the_photo_ends(hand, albedo_scene):
    """Skin that the photo shows on a slant, in the shade, was a dark band with a ragged edge beside painted skin."""
    guess, _ = albedo_scene
    inside = ((hand.template[:, 0].median() - hand.template[:, 0]) / 0.02).clamp(0, 1)
    seen = (inside > 0).float()
    learned = guess._replace(colors=guess.colors * math.exp(-0.4))
    parted = split_albedo_shading(hand, guess.colors, learned, seen, seen=seen.clamp_min(0.02))
    left = (parted.colors / guess.colors).log().mean(1)
    depth = vertex_to_gaussians(inside[:, None], hand.faces, guess)[:, 0]
    at_end, open_skin = (left[part & (learned.colors > 0.03).all(1)] for part in (depth < 0.1, depth == 1))
    assert float(open_skin.median()) == pytest.approx(-0.4 * ALBEDO_SHARE, abs=0.01)
    assert float(at_end.min()) > -0.05  # -0.08 where it stays


def test_nothing_stays_of_a_fold_too_dark_for_skin(hand, albedo_scene):
    """The fold of a squeezed palm was a dark red wound in the opened one."""
    guess, _ = albedo_scene
    line = (torch.sin(hand.template[:, :1] * 2 * math.pi / 0.03) > 0.9).float()
    on_line = vertex_to_gaussians(line, hand.faces, guess)

    def darkest(fold):
        learned = guess._replace(colors=guess.colors * (on_line * torch.tensor(fold)).exp())
        parted = split_albedo_shading(hand, guess.colors, learned)
        left = (parted.colors / guess.colors).log().mean(1)
        return float(left[(on_line[:, 0] > 0.9) & (learned.colors > 0.03).all(1)].min())

    assert darkest([-0.8, -1.0, -1.2]) > -0.01
    assert darkest([-0.3, -0.3, -0.3]) < -0.2  # a crease


def test_what_was_not_learned_does_not_change(hand, albedo_scene):
    guess, _ = albedo_scene
    parted = split_albedo_shading(hand, guess.colors, guess)
    torch.testing.assert_close(parted.colors, guess.colors)
    assert parted.shade is not None
    torch.testing.assert_close(parted.shade, torch.ones_like(parted.shade))


def test_marks_are_told_from_light_by_what_lies_across():
    line = torch.tensor([[0.364, 0.574, 0.734]])  # from dark and red to bright and pale
    assert float(mark_probability(-2 * line)) < 0.05 and float(mark_probability(0.5 * line)) < 0.05
    assert float(mark_probability(torch.tensor([[-1.0, -0.6, -0.1]]))) == 1
    assert float(mark_probability(torch.tensor([[0.65, 0.75, 0.85]]))) == 1  # white paint on skin that is not pale
    assert float(mark_probability(torch.zeros(1, 3))) == 0
    deep = torch.tensor([[-1.06, -1.75, -1.67]])  # a shadow between fingers, which became a hole in the opened palm
    assert float(mark_probability(deep)) < 0.2
    polish, ink = torch.tensor([[-0.7, -3.0, -2.2]]), torch.tensor([[-2.3, -1.8, -1.5]])
    assert float(mark_probability(polish)) == 1 and float(mark_probability(ink)) == 1


def test_ink_on_single_gaussians_is_no_mark(hand, albedo_scene):
    guess, _ = albedo_scene
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
    fine = (1 - ALBEDO_SHARE) * DARKEST_FINE * math.sqrt(3) / torch.tensor(INK).log().norm()
    assert ratio[there].max() < ALBEDO_SHARE + fine + 0.05
