"""Laws of shaping and posing the hand, and agreement with a plain numpy twin."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from oasis_warp.core import rotation
from oasis_warp.core.mirror import mirror_hand, mirror_points, mirror_pose
from oasis_warp.core.types import HandPose
from oasis_warp.hand.skinning import (
    bone_transforms,
    corrective_coefficients,
    hand21,
    rest_hand,
    skin,
    skin_surface,
)

F64 = torch.float64


@pytest.fixture(scope="module")
def exact(hand):
    return hand.to(dtype=F64)


def random_angles(hand, seed):
    """Angles spread over the inner nine tenths of every joint's range."""
    share = 0.05 + 0.9 * torch.rand(15, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)
    low, high = hand.pose_limits[1:].to(F64).unbind(-1)
    return (low + share * (high - low)).to(hand.pose_limits)


def random_rotation(seed):
    quat = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return rotation.to_matrix(quat)


def random_shape(seed):
    return torch.randn(40, generator=torch.Generator().manual_seed(seed), dtype=F64)


def at_origin(angles):
    return HandPose(angles, torch.eye(3).to(angles), torch.zeros(3).to(angles))


def numpy_skin(hand, shape, pose):
    """Blend skinning written out joint by joint with 4 x 4 matrices: (vertices, joints, tips)."""

    def rodrigues(axis, angle):
        x, y, z = axis
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k

    def homogeneous(r, t):
        return np.block([[r, np.reshape(t, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])

    vertices = hand.template.numpy() + np.einsum("vks,s->vk", hand.shape_basis.numpy(), shape)
    strengths = corrective_coefficients(hand, pose.angles).numpy()
    vertices += np.einsum("vkc,c->vk", hand.corrective_basis.numpy(), strengths)
    joints = hand.joints.numpy() + np.einsum("jks,s->jk", hand.joint_basis.numpy(), shape)
    tips = hand.tips.numpy() + np.einsum("jks,s->jk", hand.tip_basis.numpy(), shape)
    world = [homogeneous(pose.orientation.numpy(), pose.translation.numpy()) @ homogeneous(np.eye(3), joints[0])]
    for j in range(1, 16):
        flexion, abduction, twist = (
            rodrigues(hand.pose_axes[j, k].numpy(), float(pose.angles[j - 1, k])) for k in range(3)
        )
        step = homogeneous(flexion @ abduction @ twist, joints[j] - joints[hand.parents[j]])
        world.append(world[hand.parents[j]] @ step)
    bones = np.stack([world[j] @ homogeneous(np.eye(3), -joints[j]) for j in range(16)])
    move = lambda matrix, point: (matrix @ np.append(point, 1.0))[:3]  # noqa: E731
    blended = np.einsum("vj,jab->vab", hand.weights.numpy(), bones)
    skinned = np.einsum("vab,vb->va", blended[:, :3, :3], vertices) + blended[:, :3, 3]
    ends = {"thumb3": 0, "index3": 1, "middle3": 2, "ring3": 3, "little3": 4}
    moved_tips = np.stack([move(bones[hand.joint_names.index(n)], tips[i]) for n, i in ends.items()])
    return skinned, np.stack([m[:3, 3] for m in world]), moved_tips


def test_zero_angles_give_the_rest_hand(exact):
    rest = rest_hand(exact, random_shape(0))
    posed = skin(exact, rest, at_origin(torch.zeros(15, 3, dtype=F64)))
    for got, want in zip(posed, rest, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-7)  # weights are float32: their rows sum to 1 within 1e-7


def test_a_rigid_motion_moves_every_point_alike(exact):
    rest, angles = rest_hand(exact, random_shape(1)), random_angles(exact, 1)
    turn, shift = random_rotation(1), torch.tensor([0.3, -0.2, 0.7], dtype=F64)
    still = skin(exact, rest, at_origin(angles))
    moved = skin(exact, rest, HandPose(angles, turn, shift))
    for got, want in zip(moved, still, strict=True):
        torch.testing.assert_close(got, want @ turn.T + shift, rtol=0, atol=2e-7)


@pytest.mark.parametrize("seed", range(3))
def test_skinning_agrees_with_the_numpy_twin(exact, seed):
    shape, angles = random_shape(seed), random_angles(exact, seed)
    pose = HandPose(angles, random_rotation(seed), torch.tensor([0.1, 0.2, 0.5], dtype=F64))
    posed = skin(exact, rest_hand(exact, shape), pose)
    for got, want in zip(posed, numpy_skin(exact, shape.numpy(), pose), strict=True):
        np.testing.assert_allclose(got.numpy(), want, rtol=0, atol=1e-12)


def test_float32_stays_within_a_micrometre_of_float64(hand, exact):
    shape, angles = random_shape(5), random_angles(exact, 5)
    fine = skin(exact, rest_hand(exact, shape), at_origin(angles))
    coarse = skin(hand, rest_hand(hand, shape.float()), at_origin(angles.float()))
    torch.testing.assert_close(coarse.vertices.double(), fine.vertices, rtol=0, atol=1e-6)


def test_bones_turn_by_rotations_and_the_wrist_by_the_orientation(exact):
    orientation = random_rotation(7)
    pose = at_origin(random_angles(exact, 7))._replace(orientation=orientation)
    turn, shift = bone_transforms(exact, exact.joints, pose)
    eye = torch.eye(3, dtype=F64)
    torch.testing.assert_close(turn @ turn.mT, eye.expand(16, 3, 3), rtol=0, atol=1e-6)  # the axes are float32
    assert torch.linalg.det(turn).gt(0).all()
    assert torch.equal(turn[0], orientation) and not shift[0].any()


def test_positive_flexion_moves_finger_tips_to_the_palm(exact):
    angles = torch.zeros(15, 3, dtype=F64)
    angles[:12, 0] = 0.3
    rest = rest_hand(exact, torch.zeros(40, dtype=F64))
    drop = skin(exact, rest, at_origin(angles)).tips[1:, 1] - rest.tips[1:, 1]
    assert drop.lt(-0.02).all()


def test_positive_abduction_moves_finger_tips_to_the_thumb(exact):
    angles = torch.zeros(15, 3, dtype=F64)
    angles[[0, 3, 6, 9], 1] = 0.2
    rest = rest_hand(exact, torch.zeros(40, dtype=F64))
    assert (skin(exact, rest, at_origin(angles)).tips[1:, 2] - rest.tips[1:, 2]).gt(0.005).all()


def test_a_mirrored_pose_of_the_mirrored_hand_is_the_mirror_image(exact):
    pose = HandPose(random_angles(exact, 10), random_rotation(10), torch.tensor([0.1, -0.3, 0.6], dtype=F64))
    right = skin(exact, rest_hand(exact, random_shape(10)), pose)
    left_model = mirror_hand(exact)
    left = skin(left_model, rest_hand(left_model, random_shape(10)), mirror_pose(pose))
    for got, want in zip(left, right, strict=True):
        torch.testing.assert_close(got, mirror_points(want), rtol=0, atol=1e-12)


def test_a_hand_mirrored_twice_is_the_hand(hand):
    for name, value in vars(mirror_hand(mirror_hand(hand))).items():
        before = getattr(hand, name)
        assert value is before or torch.equal(value, before), name


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_many_poses_are_what_as_many_calls_give(hand, dtype, device):
    model = hand.to(device=device, dtype=dtype)
    rest = rest_hand(model, random_shape(13).to(device, dtype))
    angles = torch.stack([random_angles(hand, seed) for seed in range(3)])
    turns = torch.stack([random_rotation(seed) for seed in range(3)])
    poses = HandPose(*(part.to(device, dtype) for part in (angles, turns, torch.randn(3, 3))))
    together = skin(model, rest, poses)
    for k in range(3):
        alone = skin(model, rest, HandPose(*(part[k] for part in poses)))
        assert torch.equal(together.vertices[k], alone.vertices)
        torch.testing.assert_close(together.joints[k], alone.joints)
        torch.testing.assert_close(together.tips[k], alone.tips)
    assert torch.equal(skin_surface(model, rest, poses), together.vertices)


def test_mirroring_twice_changes_nothing(exact):
    pose = HandPose(random_angles(exact, 11), random_rotation(11), torch.ones(3, dtype=F64))
    for got, want in zip(mirror_pose(mirror_pose(pose)), pose, strict=True):
        assert torch.equal(got, want)
    assert torch.linalg.det(mirror_pose(pose).orientation) > 0


def test_landmarks_run_from_the_wrist_to_the_tip_of_each_finger(hand):
    points = hand21(rest_hand(hand, torch.zeros(40)), hand)
    names = [*hand.joint_names, "thumb", "index", "middle", "ring", "little"]
    fingers = ("thumb", "index", "middle", "ring", "little")
    want = ["wrist", *(name for f in fingers for name in (f + "1", f + "2", f + "3", f))]
    assert [names[i] for i in hand.keypoint_index] == want
    assert torch.equal(points[0], hand.joints[0])
    assert torch.equal(points[[4, 8, 12, 16, 20]], hand.tips)


def some_vertices(hand, n):
    """The same hand with `n` of its vertices only, so that finite differences stay cheap."""
    pick = torch.linspace(0, len(hand.template) - 1, n).long()
    per_vertex = ("template", "weights", "shape_basis", "corrective_basis", "segment", "region", "bone_t", "bone_theta",
                  "nail")  # fmt: skip
    return dataclasses.replace(hand, **{name: getattr(hand, name)[pick] for name in per_vertex})


def test_gradients_in_shape_and_pose_match_finite_differences(exact):
    few = some_vertices(exact, 12)

    def points(shape, angles, orientation, translation):
        posed = skin(few, rest_hand(few, shape), HandPose(angles, orientation, translation))
        return torch.cat(posed)

    inputs = [random_shape(12), random_angles(exact, 12), random_rotation(12), torch.ones(3, dtype=F64)]
    assert torch.autograd.gradcheck(points, [x.requires_grad_() for x in inputs])


def test_the_hand_moves_to_another_precision_and_device(hand, device):
    moved = hand.to(device=device, dtype=F64)
    assert moved.template.dtype == F64 and moved.template.device.type == device.type
    assert moved.faces.dtype == torch.int64 and moved.faces.device.type == device.type
    assert moved.parents == hand.parents
    pose = at_origin(torch.zeros(15, 3, dtype=F64, device=device))
    posed = skin(moved, rest_hand(moved, torch.zeros(40, dtype=F64, device=device)), pose)
    torch.testing.assert_close(posed.vertices.cpu(), hand.template.double(), rtol=0, atol=1e-7)
