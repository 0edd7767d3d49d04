import cv2
import numpy as np
import pytest
import torch
from synthetic import crop_of

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import surface
from oasis_warp.estimation.surface_offsets import BEYOND, rendered_outline_offsets
from oasis_warp.render.render import render

SIZE = 256


@pytest.fixture(scope="module")
def case(hand):
    """A photo, and Gaussians too large for its outline on a surface that is too thin at the fingers."""
    crop, truth, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=SIZE)
    too_large = truth._replace(scales=1.4 * truth.scales)
    return moved(hand, crop, -0.001 * (hand.template[:, :1] < -0.09)), too_large


def moved(hand, crop, outwards):
    normals = [surface.vertex_normals(part.vertices, hand.faces) for part in (crop.rest, crop.posed)]
    rest, posed = (
        part._replace(vertices=part.vertices + outwards * along)
        for part, along in zip((crop.rest, crop.posed), normals, strict=True)
    )
    return crop._replace(rest=rest, posed=posed)


@pytest.fixture(scope="module")
def offsets(hand, case):
    crop, gaussians = case
    return rendered_outline_offsets(hand, [gaussians], [crop])


def moved_by(hand, crop, offsets):
    along = surface.vertex_normals(crop.rest.vertices, hand.faces)
    return moved(hand, crop, (offsets * along).sum(1, keepdim=True))


def drawn(hand, gaussians, crop):
    posed = pose_gaussians(gaussians, hand.faces, crop.rest.vertices, crop.posed.vertices)
    return render(posed, crop.camera).alpha


def away(alpha, mask):
    """Mean way from the mask's outline to the drawn one at the fingers, outwards [px]."""
    solid = (mask > 0.5).float().numpy()[: SIZE // 2]
    length = cv2.morphologyEx(solid, cv2.MORPH_GRADIENT, np.ones((3, 3))) / 2  # of the outline's two sides, half each
    return ((alpha > 0.5).float().numpy()[: SIZE // 2] - solid).sum() / length.sum()


def test_the_drawn_outline_comes_to_lie_just_outside_the_masks(hand, case, offsets):
    crop, gaussians = case
    assert away(drawn(hand, gaussians, crop), crop.mask) < 0
    settled = moved_by(hand, crop, offsets)
    assert away(drawn(hand, gaussians, settled), crop.mask) == pytest.approx(BEYOND, abs=0.25)


def test_a_slit_that_the_photo_does_not_have_is_closed(hand):
    crop, gaussians, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=SIZE)
    solid = (crop.mask > 0.5).numpy().astype(np.uint8)
    closed = torch.from_numpy(cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((5, 5)))).float()
    slit = (closed > 0.5) & (crop.mask < 0.5)
    assert slit.sum() >= 30
    without = crop._replace(mask=closed)
    closer = moved_by(hand, crop, rendered_outline_offsets(hand, [gaussians], [without]))
    before, after = (drawn(hand, gaussians, e)[slit].mean() for e in (crop, closer))
    assert before < 0.2
    assert after > 0.5  # .41 where only outlines are met


def test_what_lies_off_the_outline_stays(hand, offsets):
    length = offsets.norm(dim=1)
    assert 0.0003 < length.max() < 0.004
    along, _, across = hand.template.T
    palm = (along > -0.08) & (along < -0.05) & ((across - across[along > -0.08].mean()).abs() < 0.01)
    assert length[palm].max() < 0.1 * length.max()


def test_a_photo_without_an_outline_says_nothing(hand, case, offsets):
    crop, gaussians = case
    nothing = crop._replace(mask=torch.zeros_like(crop.mask))
    assert not rendered_outline_offsets(hand, [gaussians], [nothing]).any()
    assert torch.equal(rendered_outline_offsets(hand, [gaussians] * 2, [nothing, crop]), offsets)
