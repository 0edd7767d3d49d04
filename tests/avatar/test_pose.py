import torch
from synthetic import PALM_TO_CAMERA, posed_hand

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import rotation
from oasis_warp.core.mirror import mirror_canonical, mirror_points
from oasis_warp.ops import rest_mesh


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


def test_the_mirrored_gaussians_on_the_mirrored_surface_are_the_mirror_image(hand):
    canonical, rest = canonical_and_rest(hand)
    generator = torch.Generator().manual_seed(0)
    canonical = canonical._replace(offsets=0.001 * torch.randn(canonical.offsets.shape, generator=generator))
    fist = posed_hand(hand, "fist")[2].vertices
    posed = pose_gaussians(canonical, hand.faces, rest.vertices, fist)
    mirrored = mirror_canonical(canonical)
    left = pose_gaussians(mirrored, hand.faces, mirror_points(rest.vertices), mirror_points(fist))
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    torch.testing.assert_close(left.means, posed.means @ flip, atol=1e-7, rtol=0)
    torch.testing.assert_close(covariances(left), flip @ covariances(posed) @ flip, atol=1e-12, rtol=1e-4)
    back = mirror_canonical(mirrored)
    assert back.shade is canonical.shade
    assert all(torch.equal(a, b) for a, b in zip(back[:-1], canonical[:-1], strict=True))


def test_many_poses_are_what_as_many_calls_give_and_a_measured_surface_poses_as_its_vertices(hand):
    canonical, rest = canonical_and_rest(hand)
    surfaces = [posed_hand(hand, name)[2].vertices for name in ("fist", "pinch")]
    still = rest_mesh(rest.vertices, hand.faces)
    together = pose_gaussians(canonical, hand.faces, still, torch.stack(surfaces))
    for k, surface in enumerate(surfaces):
        alone = pose_gaussians(canonical, hand.faces, rest.vertices, surface)
        assert all(torch.equal(a[k], b) for a, b in zip(together[:3], alone[:3], strict=True))
