import math

import pytest
import torch

from oasis_warp.avatar.anchors import RIM_FADE, place_anchors, vertex_to_gaussians
from oasis_warp.avatar.densify import densify
from oasis_warp.avatar.pose import pose_gaussians, with_photo
from oasis_warp.avatar.wrist import close_wrist
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import HandLight, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.render.render import render

SLEEVE, SKIN, PALM = torch.tensor([0.1, 0.2, 0.6]), torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.2, 0.5, 0.1])


@pytest.fixture(scope="module", params=[False, True], ids=["coarse", "fine"])
def hands(hand, request):
    """A hand at rest with a sleeve at the rim, then skin, then something else; the same closed."""
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1]))
    anchors, vertices = place_anchors(hand, rest), rest.vertices
    away = torch.cdist(vertices, vertices[hand.rim]).amin(1)
    at = torch.cat([away[anchors.vertex_index], away[hand.faces[anchors.face_index]].amin(1)])[:, None]
    colors = torch.where(at < 0.6 * RIM_FADE, SLEEVE, torch.where(at < 0.03, SKIN, PALM))
    gaussians = anchors.with_colors(colors)
    if request.param:
        gaussians = densify(gaussians, vertices, hand.faces, torch.full((len(hand.faces),), 2)).gaussians
    return vertices, gaussians, close_wrist(hand, gaussians, vertices)


def centers(hand, rest, gaussians):
    on_faces = (rest[hand.faces[gaussians.face_index]] * gaussians.barycentrics[..., None]).sum(1)
    return torch.cat([rest[gaussians.vertex_index] + gaussians.offsets, on_faces])


def test_nobody_looks_into_a_hand(hand, hands):
    rest, before, after = hands
    camera = orbit_camera(rest, -math.pi / 2, size=96)  # where the arm would be: the hand lies along -x
    middle = rest[hand.rim].mean(0)
    points = (middle + 0.6 * (rest[hand.rim] - middle)) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    x, y, _ = (points @ camera.K.T / points[:, 2:]).long().unbind(1)
    opened, closed = (
        render(pose_gaussians(g, hand.faces, rest, rest), camera).image[y, x] for g in (before, after)
    )
    assert (closed - SKIN).abs().max() < 0.03
    assert (opened - SKIN).abs().max() > 0.3


def test_the_end_is_opaque_and_has_the_colour_of_the_skin_before_it(hand, hands):
    rest, before, after = hands

    def end(gaussians):
        return torch.cdist(centers(hand, rest, gaussians), rest[hand.rim]).amin(1) < 0.3 * RIM_FADE

    assert after.opacities[end(after)].min() > 0.9 and before.opacities[end(before)].median() < 0.5
    assert (after.colors[end(after)] - SKIN).abs().max() < 1e-4


def test_the_hand_beyond_the_fade_keeps_its_bits_and_the_cap_goes_with_the_wrist(hand, hands):
    rest, before, after = hands
    cap = torch.zeros(len(after.opacities), dtype=torch.bool)
    cap[: len(after.vertex_index)] = after.offsets.norm(dim=1) > 2e-3
    beyond = [torch.cdist(centers(hand, rest, g), rest[hand.rim]).amin(1) > 2 * RIM_FADE for g in hands[1:]]
    for name in ("quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(before, name)[beyond[0]], getattr(after, name)[beyond[1] & ~cap])
    fist = HandPose(named_pose(hand, "fist"), torch.eye(3), torch.zeros(3))
    posed = skin(hand, rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1])), fist).vertices
    still, moved = (pose_gaussians(after, hand.faces, rest, to).means[cap] for to in (rest, posed))
    assert (moved - still).norm(dim=1).max() < 0.004  # the rim itself moves by less than that


def test_light_falls_on_the_cap_as_on_one_end(hand, hands):
    """It came with the rim's vertices, whose sides made a cone of dark and bright wedges."""
    rest, _, after = hands
    cap = after.offsets.norm(dim=1) > 2e-3
    above = torch.tensor([[1.0], [0.0], [0.8], [0.0]]).expand(4, 3)
    lamp = HandLight(above, torch.tensor([[0.1] * 3, [3.0] * 3]), torch.ones(3))
    lit = pose_gaussians(after, hand.faces, rest, rest, with_photo(lamp, rest, rest, hand.faces)).colors
    on_cap = (lit / after.colors)[: len(cap)][cap]
    assert on_cap.amax() - on_cap.amin() < 1e-3
    beside = (lit / after.colors)[: len(cap)][~cap]
    assert beside.amax() - beside.amin() > 0.3


def test_two_colours_of_the_arm_meet_gradually_on_the_cap(hand, hands):
    """With one width of averaging its middle was cut in two: far from all skin, the nearest alone counted."""
    rest, before, _ = hands
    side = (rest[:, 1] > rest[hand.rim, 1].mean()).float()[:, None]
    two = before._replace(colors=torch.where(vertex_to_gaussians(side, hand.faces, before) > 0.5, SKIN, PALM))
    after = close_wrist(hand, two, rest)
    cap = torch.nonzero(after.offsets.norm(dim=1) > 2e-3)[:, 0]
    at = (rest[after.vertex_index] + after.offsets)[cap]
    near = torch.cdist(at, at) < 0.0035
    steps = (after.colors[cap][:, None] - after.colors[cap][None]).abs().amax(-1)[near]
    assert steps.max() < 0.25 * (SKIN - PALM).abs().max()


def test_shade_of_the_arm_ends_before_the_cap(hand, hands):
    rest, before, _ = hands
    shaded = before._replace(shade=torch.full_like(before.colors, 0.4))
    after = close_wrist(hand, shaded, rest)
    cap = torch.nonzero(after.offsets.norm(dim=1) > 2e-3)[:, 0]
    assert after.shade is not None and after.shade[cap].min() > 0.999 and after.shade.min() == pytest.approx(0.4)
