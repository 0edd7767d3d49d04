"""Anchors and mean colours of many hands at once equal those of one."""

import pytest
import torch

from oasis_warp.avatar.anchors import OPACITY, batch_anchors, faces_of_vertices, place_anchors
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import observe, sight
from oasis_warp.avatar.prior import MeanHands, MeanPrior, estimate_melanin
from oasis_warp.core import rotation
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
def test_every_gaussian_is_the_one_of_place_anchors(hand, hands, anchors, which):
    expected = place_anchors(hand, hands[which])
    kept = torch.cat([expected.vertex_index, len(hand.template) + expected.face_index])
    a = covariances(anchors.quats[which][kept], anchors.scales[which][kept])
    b = covariances(expected.quats, expected.scales)
    assert float(((a - b).abs().amax((1, 2)) / b.abs().amax((1, 2))).max()) < 2e-5
    torch.testing.assert_close(anchors.scales[which][kept], expected.scales, atol=1e-8, rtol=1e-4)
    torch.testing.assert_close(OPACITY * anchors.fade[which][kept], expected.opacities, atol=1e-6, rtol=1e-5)


def test_those_that_place_anchors_leaves_out_are_too_faint_to_be_drawn(hand, hands, anchors):
    expected = place_anchors(hand, hands[0])
    out = torch.ones(len(anchors.fade[0]), dtype=torch.bool)
    out[torch.cat([expected.vertex_index, len(hand.template) + expected.face_index])] = False
    assert bool(out.any())
    assert float(OPACITY * anchors.fade[0][out].max()) < 1 / 255


def test_visibility_and_colours_are_those_of_observe(network, crops, batch, hand):
    sighting = sight(batch, network.faces, network.vertex_faces, network.vertex_index)
    for k, crop in enumerate(crops):
        seen = observe(hand, crop)
        torch.testing.assert_close(sighting.colors[k], seen.colors, atol=1e-5, rtol=0)
        torch.testing.assert_close(sighting.confidence[k], seen.confidence, atol=1e-4, rtol=0)


def test_tones_are_those_of_the_mean_prior(hand, batch, crops, network):
    sighting = sight(batch, network.faces, network.vertex_faces, network.vertex_index)
    mean = MeanHands(hand)(sighting.colors, sighting.confidence)
    regions = label_regions(hand)
    for k, crop in enumerate(crops):
        melanin = estimate_melanin(regions, observe(hand, crop))
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
