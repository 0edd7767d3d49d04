"""Skin is told from light."""

import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.adaptation.sh_lighting import SKIN_DEVIATION, weighted_deviation
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import AdaptConfig


@pytest.fixture(scope="module")
def skin(hand):
    return region_colors(label_regions(hand), 0.03)


def lines(hand, height, spacing):
    """Across the hand."""
    return height * torch.sin(hand.template[:, :1] * (2 * torch.pi / spacing))


def adapted(hand, skin, shown, light):
    """Colours at the vertices that the photo shows well, and the true ones, after the one gain between them."""
    crop, _, _ = crop_of(hand, shown.clamp(0, 1))
    prior = MeanPrior(hand)(crop)
    prior = prior._replace(colors=vertex_to_gaussians(skin, hand.faces, prior))
    made = adapt(hand, prior, crop, AdaptConfig(light=light, texture_steps=0, reference_views=0)).gaussians
    index = made.vertex_index
    seen = observe(hand, crop).confidence[index] > 0.9
    found, true = made.colors[: len(index)][seen], skin[index][seen]
    return found * (true.mean(0) / found.mean(0)), true, index[seen]


def test_a_shadow_is_kept_or_left_out_as_asked(hand, skin):
    side = hand.template[:, :1]
    shadow = 1 - 0.25 * torch.sigmoid((side - side.mean()) / 0.01)
    errors = {}
    for light in ("keep", "even"):
        found, true, _ = adapted(hand, skin, skin * shadow, light)
        errors[light] = float((found - true).square().mean().sqrt())
    assert errors["even"] < 0.3 * errors["keep"]


def test_fine_lines_of_the_skin_stay_and_harsh_shading_does_not(hand, skin):
    def share_kept(height):
        pattern, found = lines(hand, height, 0.01), {}
        for light in ("keep", "even"):
            colors, true, index = adapted(hand, skin, skin + pattern, light)
            found[light] = float(((colors - true) * pattern[index]).sum())
        return found["even"] / found["keep"]

    assert share_kept(SKIN_DEVIATION) > 0.8
    assert share_kept(0.08) < 0.15


def test_a_tattoo_does_not_count_as_what_most_skin_does():
    generator = torch.Generator().manual_seed(0)
    values = 0.01 * torch.randn(1000, 3, generator=generator)
    weight = torch.ones(1000)
    plain = float(weighted_deviation(values, weight))
    values[:200] = 0.3
    assert plain == pytest.approx(0.01, rel=0.15)
    assert float(weighted_deviation(values, weight)) < 1.3 * plain
    weight[:] = 0
    weight[:200] = 1
    assert float(weighted_deviation(values, weight)) == pytest.approx(0.3)
