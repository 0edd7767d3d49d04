import torch
from synthetic import PALM_TO_CAMERA, posed_hand

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.pose import mirror_gaussians, pose_gaussians
from oasis_warp.core import rotation


def canonical_and_rest(hand):
    rest, _, _ = posed_hand(hand)
    anchors = place_anchors(hand, rest)
    return anchors.with_colors(torch.full((len(anchors.opacities), 3), 0.5)), rest


def covariances(gaussians):
    half = rotation.to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    return half @ half.transpose(1, 2)


def test_the_rest_pose_returns_the_canonical_gaussians(hand):
    canonical, rest = canonical_and_rest(hand)
    posed = pose_gaussians(canonical, hand.faces, rest.vertices, rest.vertices)
    torch.testing.assert_close(posed.means, vertex_to_gaussians(rest.vertices, hand.faces, canonical))
    torch.testing.assert_close(posed.scales, canonical.scales, atol=1e-8, rtol=1e-4)
    dots = (posed.quats * canonical.quats).sum(-1).abs()
    assert float(dots.min()) > 1 - 1e-5


def test_a_rigid_motion_moves_gaussians_rigidly(hand):
    canonical, rest = canonical_and_rest(hand)
    shift = torch.tensor([0.1, -0.2, 0.5])
    posed = pose_gaussians(canonical, hand.faces, rest.vertices, rest.vertices @ PALM_TO_CAMERA.T + shift)
    still = pose_gaussians(canonical, hand.faces, rest.vertices, rest.vertices)
    torch.testing.assert_close(posed.means, still.means @ PALM_TO_CAMERA.T + shift, atol=1e-6, rtol=0)
    turned = PALM_TO_CAMERA @ covariances(still) @ PALM_TO_CAMERA.T
    torch.testing.assert_close(covariances(posed), turned, atol=1e-10, rtol=1e-3)


def test_offsets_turn_with_the_surface(hand):
    canonical, rest = canonical_and_rest(hand)
    outwards = torch.zeros_like(canonical.offsets)
    outwards[:, 1] = 0.002
    lifted = canonical._replace(offsets=outwards)
    posed = pose_gaussians(lifted, hand.faces, rest.vertices, rest.vertices @ PALM_TO_CAMERA.T)
    n = len(canonical.vertex_index)
    expected = (rest.vertices[canonical.vertex_index] + outwards) @ PALM_TO_CAMERA.T
    torch.testing.assert_close(posed.means[:n], expected, atol=1e-6, rtol=0)


def test_mirroring_mirrors_every_covariance_and_twice_is_nothing(hand):
    canonical, rest = canonical_and_rest(hand)
    posed = pose_gaussians(canonical, hand.faces, rest.vertices, posed_hand(hand, "fist")[2].vertices)
    mirrored = mirror_gaussians(posed)
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    torch.testing.assert_close(mirrored.means, posed.means @ flip)
    torch.testing.assert_close(covariances(mirrored), flip @ covariances(posed) @ flip, atol=1e-12, rtol=1e-4)
    assert all(torch.equal(a, b) for a, b in zip(mirror_gaussians(mirrored), posed, strict=True))
