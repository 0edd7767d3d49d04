"""Pose correctives do nothing at rest, and bend fingers without losing volume or crossing themselves."""

import dataclasses

import pytest
import torch
from hand_build.quality import enclosed_volume, self_crossings

from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import bone_transforms, corrective_coefficients, rest_hand, skin

HINGES = [2, 3, 5, 6, 8, 9, 11, 12, 14, 15]


@pytest.fixture(scope="module")
def plain(hand):
    return dataclasses.replace(hand, corrective_basis=hand.corrective_basis[..., :0])


def bent(hand, joint, share):
    angles = torch.zeros(15, 3)
    angles[joint - 1, 0] = share * hand.pose_limits[joint, 0, 1]
    return angles


def surface(hand, angles):
    pose = HandPose(angles, torch.eye(3), torch.zeros(3))
    return skin(hand, rest_hand(hand, torch.zeros(40)), pose).vertices.double().numpy()


def volume(hand, angles):
    return enclosed_volume(surface(hand, angles), hand.faces.numpy(), hand.rim.numpy())


def test_at_rest_strengths_and_their_slopes_are_zero(hand):
    angles = torch.zeros(15, 3, requires_grad=True)
    strengths = corrective_coefficients(hand, angles)
    assert strengths.eq(0).all()
    (slope,) = torch.autograd.grad(strengths.sum(), angles)
    assert slope.eq(0).all()


def test_strengths_have_gradients_that_match_finite_differences(hand):
    exact = hand.to(dtype=torch.float64)
    angles = torch.rand(15, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: corrective_coefficients(exact, a), angles)


def test_a_hand_without_correctives_keeps_its_rest_surface(plain):
    angles = torch.full((15, 3), 0.3)
    assert corrective_coefficients(plain, angles).shape == (0,)
    rest = rest_hand(plain, torch.zeros(40))
    pose = HandPose(angles, torch.eye(3), torch.zeros(3))
    rotation, translation = bone_transforms(plain, rest.joints, pose)
    moved = (rotation @ rest.vertices[:, None, :, None])[..., 0] + translation
    alone = (plain.weights[..., None] * moved).sum(1)
    torch.testing.assert_close(skin(plain, rest, pose).vertices, alone, rtol=0, atol=1e-6)


def test_a_hand_with_other_correctives_is_refused(hand):
    odd = dataclasses.replace(hand, corrective_basis=hand.corrective_basis[..., :7])
    with pytest.raises(ValueError, match="hand: expected 0 or 30 or 135 pose correctives, got 7"):
        corrective_coefficients(odd, torch.zeros(15, 3))
    with pytest.raises(ValueError, match="hand: expected 0 or 30 or 135 pose correctives, got 7"):
        surface(odd, torch.zeros(15, 3))


def test_each_joint_corrects_its_own_finger_those_beside_it_and_the_palm(hand):
    reach = hand.corrective_basis.unflatten(-1, (15, 2)).abs().amax((1, 3)) > 1e-4
    row = ["thumb", "index", "middle", "ring", "little"]
    for joint in range(1, 16):
        touched = reach[:, joint - 1]
        assert touched.sum() > 500
        place = row.index(hand.joint_names[joint][:-1])
        far = [other for other in (3, 6, 9, 12, 15) if abs(row.index(hand.joint_names[other][:-1]) - place) > 1]
        assert not (touched & torch.isin(hand.segment, torch.tensor(far))).any()


@pytest.mark.parametrize("joint", HINGES)
def test_a_finger_joint_folds_without_crossing_itself(hand, joint):
    assert self_crossings(surface(hand, bent(hand, joint, 0.75)), hand.faces.numpy()) == 0


def test_blend_skinning_alone_would_cross_itself(hand, plain):
    angles = bent(hand, hand.joint_names.index("index2"), 0.75)
    assert self_crossings(surface(plain, angles), hand.faces.numpy()) > 20


@pytest.mark.parametrize("name", ["fist", "thumbs_up", "pinch", "ok"])
def test_a_pose_gets_a_third_of_its_lost_volume_back(hand, plain, name):
    rest = volume(hand, torch.zeros(15, 3))
    angles = named_pose(hand, name)
    lost_before, lost = rest - volume(plain, angles), rest - volume(hand, angles)
    assert 0 < lost < 2 / 3 * lost_before


def test_nails_keep_their_shape(hand):
    moved = hand.corrective_basis[hand.nail > 0.5].norm(dim=1).amax()
    assert moved < 1e-3  # at strength 1, a bend by 90 degrees
