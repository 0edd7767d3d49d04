"""Gaussians for the detail that a prior has none for."""

import pytest
import torch
from synthetic import evidence_of

from oasis_warp.avatar.anchors import MIN_OPACITY, place_anchors
from oasis_warp.avatar.detail import DETAIL_OPACITY, DETAIL_SPREAD, carry_detail
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import AdaptConfig
from oasis_warp.losses.image import masked_psnr
from oasis_warp.ops import blend_colors
from oasis_warp.training.adapt import adapt
from oasis_warp.training.views import freeze_view


@pytest.fixture(scope="module")
def evidence(hand):
    """A hand with spots of 3 mm, which large Gaussians cannot show."""
    spots = 0.5 + 0.3 * torch.sin(hand.template * (2 * torch.pi / 0.003)).prod(1, keepdim=True).expand(-1, 3)
    return evidence_of(hand, spots.contiguous(), size=192)[0]


@pytest.fixture(scope="module")
def solid(hand, evidence):
    return MeanPrior(hand)(evidence)


@pytest.fixture(scope="module")
def faint(solid):
    """As a network leaves it: large vertices below the surface, faces that can hardly be seen, the last 500 dropped."""
    n = len(solid.vertex_index)
    opacities = torch.cat([0.6 * solid.opacities[:n], 0.02 * solid.opacities[n:]])
    scales = torch.cat([1.8 * solid.scales[:n], solid.scales[n:]])
    parts = solid._replace(opacities=opacities, scales=scales)._asdict()
    for name in ("face_index", "barycentrics", "quats", "scales", "opacities", "colors"):
        parts[name] = parts[name][:-500]
    return type(solid)(**parts)


def test_faces_that_are_opaque_stay_as_they_are(hand, solid, evidence):
    assert carry_detail(hand, solid, evidence.rest) is solid


def test_faint_and_missing_faces_get_small_gaussians_and_vertices_stay(hand, faint, solid, evidence):
    carried, n = carry_detail(hand, faint, evidence.rest), len(faint.vertex_index)
    anchors = place_anchors(hand, evidence.rest)
    assert torch.equal(carried.face_index, anchors.face_index)
    torch.testing.assert_close(carried.scales[n:], DETAIL_SPREAD * anchors.scales[n:])
    torch.testing.assert_close(carried.opacities[n:], DETAIL_OPACITY * anchors.opacities[n:])
    torch.testing.assert_close(carried.barycentrics, anchors.barycentrics)
    torch.testing.assert_close(carried.colors[n:], solid.colors[n:], atol=0.05, rtol=0)  # those at the end too
    for name in ("offsets", "vertex_index"):
        assert getattr(carried, name) is getattr(faint, name)
    for name in ("quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(carried, name)[:n], getattr(faint, name)[:n])


def test_only_faces_that_are_too_faint_are_replaced(hand, solid, evidence):
    n = len(solid.vertex_index)
    opacities, turned = solid.opacities.clone(), solid.quats.flip(1)
    opacities[n::2] = MIN_OPACITY
    carried = carry_detail(hand, solid._replace(opacities=opacities, quats=turned), evidence.rest)
    assert torch.equal(carried.quats[n::2], solid.quats[n::2])
    assert torch.equal(carried.quats[n + 1 :: 2], turned[n + 1 :: 2])
    assert torch.equal(carried.opacities[n + 1 :: 2], opacities[n + 1 :: 2])


def test_the_photo_finds_something_to_paint_on(hand, faint, evidence):
    def likeness(gaussians):
        posed = pose_gaussians(gaussians, hand.faces, evidence.rest.vertices, evidence.posed.vertices)
        picture = blend_colors(freeze_view(posed, evidence.camera), gaussians.colors)
        return masked_psnr(picture, evidence.image, (evidence.mask > 0.99).float())

    config = AdaptConfig(calibration_steps=5, texture_steps=40, reference_views=1)
    adapted = adapt(hand, faint, evidence, config).gaussians
    assert len(adapted.face_index) == len(faint.face_index) + 500
    coarse = adapted._replace(opacities=torch.cat([adapted.opacities[: len(faint.vertex_index)],
                                                   0.02 * adapted.opacities[len(faint.vertex_index) :]]))  # fmt: skip
    assert likeness(adapted) > likeness(coarse) + 1
