"""Anchors and mean colours of many hands at once equal those of one."""

import math

import pytest
import torch

from oasis_warp.avatar.anchors import OPACITY, batch_anchors, place_anchors
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import observe, observe_batch
from oasis_warp.avatar.prior import (
    DARKEST,
    LIGHTEST,
    SIGMA_CAST,
    SIGMA_COLOR,
    SIGMA_EXPOSURE,
    TONES,
    MeanHands,
    MeanPrior,
)
from oasis_warp.core import rotation, surface
from oasis_warp.core.surface import faces_of_vertices
from oasis_warp.hand.skinning import rest_hand


@pytest.fixture(scope="module")
def vertex_faces(hand):
    return faces_of_vertices(hand.faces, len(hand.template))


@pytest.fixture(scope="module")
def hands(hand):
    shapes = torch.randn(2, len(hand.shape_names), generator=torch.Generator().manual_seed(1))
    return [rest_hand(hand, 0.5 * shape) for shape in shapes]


@pytest.fixture(scope="module")
def anchors(hand, hands, vertex_faces):
    return batch_anchors(torch.stack([rest.vertices for rest in hands]), hand.faces, vertex_faces, hand.rim)


def covariances(quats, scales):
    half = rotation.to_matrix(quats) * scales[:, None, :]
    return half @ half.transpose(1, 2)


def test_each_vertex_has_its_faces_once(hand, vertex_faces):
    real = vertex_faces < len(hand.faces)
    assert int(real.sum()) == hand.faces.numel()
    owners = torch.arange(len(hand.template))[:, None].expand_as(vertex_faces)[real]
    assert bool((hand.faces[vertex_faces[real]] == owners[:, None]).any(1).all())


@pytest.mark.parametrize("which", [0, 1])
def test_vertices_are_discs_and_faces_uniform_plates(hand, hands, anchors, which):
    vertices, n = hands[which].vertices.double(), len(hand.template)
    spread = 0.75 * (surface.vertex_areas(vertices, hand.faces) / torch.pi).sqrt().clamp_min(1e-4)
    torch.testing.assert_close(anchors.scales[which][:n, 0], spread.float(), atol=1e-8, rtol=1e-4)
    corners = vertices[hand.faces]
    arms = corners - corners.mean(1, keepdim=True)
    variance, axes = torch.linalg.eigh(arms.transpose(1, 2) @ arms / 12)  # ascending: across, short, long
    long = (1.5 * variance[:, 2].sqrt()).clamp_min(1e-4)
    short = torch.maximum(1.5 * variance[:, 1].clamp_min(0).sqrt(), long / 3).clamp_min(1e-4)
    expected = (axes * torch.stack([0.5 * short, short, long], -1)[:, None]).float()
    expected = expected @ expected.transpose(1, 2)
    found = covariances(anchors.quats[which][n:], anchors.scales[which][n:])
    error = (found - expected).abs().amax((1, 2)) / expected.abs().amax((1, 2))
    assert float(error.quantile(0.999)) < 1e-3  # two equal axes have no direction


def test_anchors_of_one_hand_leave_out_those_too_faint_to_be_drawn(hand, hands, anchors):
    alone = place_anchors(hand, hands[0])
    kept = torch.cat([alone.vertex_index, len(hand.template) + alone.face_index])
    torch.testing.assert_close(alone.scales, anchors.scales[0][kept])
    torch.testing.assert_close(alone.opacities, OPACITY * anchors.fade[0][kept])
    out = torch.ones(len(anchors.fade[0]), dtype=torch.bool)
    out[kept] = False
    assert bool(out.any())
    assert float(OPACITY * anchors.fade[0][out].max()) < 1 / 255


def test_photos_of_a_batch_are_observed_as_alone(network, crops, batch, hand):
    observation = observe_batch(batch, network.faces, network.vertex_faces, network.vertex_index)
    for k, crop in enumerate(crops):
        seen = observe(hand, crop)
        torch.testing.assert_close(observation.colors[k], seen.colors, atol=1e-5, rtol=0)
        torch.testing.assert_close(observation.confidence[k], seen.confidence, atol=1e-4, rtol=0)


def expected_melanin(regions, seen):
    """The posterior mean of the tone, one tone after the other."""
    weight = seen.confidence[:, None]
    logs, costs = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES), []
    for melanin in logs.exp().tolist():
        model = region_colors(regions, melanin)
        gain = (weight * model * seen.colors).sum(0) / (weight * model * model).sum(0)
        residual = (weight * (gain * model - seen.colors) ** 2).sum() / (3 * weight.sum())
        log_gain = gain.log()
        cast = (log_gain[[0, 2]] - log_gain[1]) / SIGMA_CAST
        costs.append(residual / SIGMA_COLOR**2 + (log_gain.mean() / SIGMA_EXPOSURE) ** 2 + (cast**2).sum())
    return float((torch.softmax(-torch.stack(costs) / 2, dim=0) * logs).sum().exp())


def test_tones_are_posterior_means(hand, batch, crops, network):
    seen = observe_batch(batch, network.faces, network.vertex_faces, network.vertex_index)
    mean = MeanHands(hand)(seen.colors, seen.confidence)
    regions = label_regions(hand)
    for k, crop in enumerate(crops):
        melanin = expected_melanin(regions, observe(hand, crop))
        assert float(mean.log_melanin[k].exp()) == pytest.approx(melanin, rel=1e-3)
        torch.testing.assert_close(mean.colors[k], region_colors(regions, melanin), atol=2e-3, rtol=0)


def test_gains_say_how_much_brighter_the_photo_is(hand):
    colors = MeanPrior(hand).vertex_colors(0.05)
    gain = torch.tensor([1.1, 0.95, 0.9])
    mean = MeanHands(hand)((colors * gain)[None], torch.ones(1, len(colors)))
    torch.testing.assert_close(mean.colors[0] * mean.log_gain[0].exp(), colors * gain, atol=0.03, rtol=0)


def test_a_photo_that_shows_nothing_gets_the_middle_tone(hand):
    mean = MeanHands(hand)(torch.rand(1, len(hand.template), 3), torch.zeros(1, len(hand.template)))
    assert bool(mean.colors.isfinite().all())
    assert 0 < float(mean.colors.min()) and float(mean.colors.max()) < 1
