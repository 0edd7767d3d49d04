"""Laws of shaping and posing the hand, and agreement with a plain numpy twin; named poses and their limits."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hand_build.quality import self_crossings

from oasis_warp.core import rotation
from oasis_warp.core.mirror import mirror_hand, mirror_points, mirror_pose
from oasis_warp.core.types import HandPose
from oasis_warp.estimation.fit_problem import FitState
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.poses import POSE_NAMES, named_pose, pose_sequence
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


def posed(hand, name):
    pose = HandPose(named_pose(hand, name), torch.eye(3), torch.zeros(3))
    return skin(hand, rest_hand(hand, torch.zeros(40)), pose)


def test_rest_is_zero_and_open_is_straight(hand):
    assert named_pose(hand, "rest").eq(0).all()
    points = hand21(posed(hand, "open"), hand)
    for first in (5, 9, 13, 17):
        reach = (points[first + 3] - points[first]).norm()
        length = (points[first + 1 : first + 4] - points[first : first + 3]).norm(dim=-1).sum()
        assert reach > 0.995 * length


def test_open_fingers_are_further_apart_than_at_rest(hand):
    tips = {name: hand21(posed(hand, name), hand)[[4, 8, 12, 16, 20]] for name in ("rest", "open")}
    gaps = {name: (t[1:] - t[:-1]).norm(dim=-1) for name, t in tips.items()}
    assert (gaps["open"] > gaps["rest"]).all()


@pytest.mark.parametrize("name", ["pinch", "ok"])
def test_thumb_and_index_meet(hand, name):
    surface = posed(hand, name)
    near = hand.weights[:, hand.joint_names.index("thumb3")] > 0.9
    thumb = surface.vertices[near]
    index = surface.vertices[hand.weights[:, hand.joint_names.index("index3")] > 0.9]
    gap = torch.cdist(thumb, index).min()
    assert gap < 0.003
    tips = hand21(surface, hand)[[4, 8]]
    assert (tips[0] - tips[1]).norm() < 0.025  # two half finger thicknesses


@pytest.mark.parametrize("name", ["rest", "open", "relaxed", "pinch", "ok"])
def test_poses_without_a_fist_do_not_cross_themselves(hand, name):
    assert self_crossings(posed(hand, name).vertices.double().numpy(), hand.faces.numpy()) == 0


def test_a_fist_hides_the_finger_tips_in_the_palm_under_the_thumb(hand):
    points = hand21(posed(hand, "fist"), hand)
    palm = points[[5, 9, 13, 17]]
    assert ((points[[8, 12, 16, 20]] - palm).norm(dim=-1) < 0.045).all()
    # The thumb lies in front of the bent fingers: further to the palm side (-y) than the index's middle bone.
    assert points[4, 1] < points[6:8, 1].mean()


def test_thumbs_up_is_a_fist_with_the_thumb_far_off(hand):
    fist, up = hand21(posed(hand, "fist"), hand), hand21(posed(hand, "thumbs_up"), hand)
    torch.testing.assert_close(fist[5:], up[5:])
    assert (up[4] - up[5]).norm() > 0.06


@pytest.mark.parametrize(("name", "long"), [("victory", (8, 12)), ("point", (8,))])
def test_only_the_named_fingers_stand_out(hand, name, long):
    points = hand21(posed(hand, name), hand)
    for tip in (8, 12, 16, 20):
        reach = (points[tip] - points[tip - 3]).norm()
        assert (reach > 0.06) == (tip in long)


def test_an_unknown_pose_is_named_in_the_message(hand):
    with pytest.raises(ValueError, match=r"pose: expected one of rest, .*, got 'wave'\.$"):
        named_pose(hand, "wave")


def test_a_sequence_visits_each_pose_and_returns_to_the_first(hand):
    names = ["open", "fist", "ok"]
    frames = pose_sequence(hand, names, 8)
    assert len(frames) == 24
    for i, name in enumerate(names):
        torch.testing.assert_close(frames[8 * i], named_pose(hand, name))


def test_a_sequence_can_be_repeated_without_a_jump(hand):
    frames = torch.stack(pose_sequence(hand, ["open", "fist"], 30))
    steps = (frames.roll(-1, 0) - frames).abs().amax((1, 2))
    swing = (named_pose(hand, "fist") - named_pose(hand, "open")).abs().max()
    assert steps.max() < 1.1 * torch.pi / 2 / 30 * swing  # the steepest slope of half a cosine
    assert steps[[0, 29, 30, 59]].max() < 0.1 * steps.max()  # and it starts and stops gently


def test_every_frame_of_a_sequence_keeps_the_limits(hand):
    low, high = hand.pose_limits[1:].unbind(-1)
    for angles in pose_sequence(hand, POSE_NAMES, 3):  # each third one is a named pose
        assert ((angles >= low - 1e-6) & (angles <= high + 1e-6)).all()


def test_a_sequence_of_nothing_is_refused(hand):
    with pytest.raises(ValueError, match="names: expected at least one pose, got none"):
        pose_sequence(hand, [], 5)
    with pytest.raises(ValueError, match="frames_per_transition: expected 1 or more, got 0"):
        pose_sequence(hand, ["rest"], 0)


STEP = 1e-6


@pytest.fixture(scope="module")
def kinematics(hand):
    return HandKinematics(hand)


@pytest.fixture
def angles_and_shape(kinematics):
    rng = np.random.default_rng(3)
    return rng.uniform(-0.3, 1.2, len(kinematics.dofs)), rng.normal(size=kinematics.shape_basis.shape[2])


def test_surface_is_that_of_skinning_with_its_correctives(hand, kinematics, angles_and_shape):
    angles, shape = angles_and_shape
    table = kinematics.all_angles(angles)
    pose = HandPose(torch.from_numpy(table[1:]).float(), torch.eye(3), torch.zeros(3))
    posed = skin(hand, rest_hand(hand, torch.from_numpy(shape).float()), pose)
    joints = kinematics.pose_joints(angles, shape)
    # float32 of a hand of 0.2 m
    np.testing.assert_allclose(kinematics.surface(joints), posed.vertices, atol=3e-7)
    np.testing.assert_allclose(joints.position, posed.joints, atol=3e-7)


def test_landmark_derivatives_are_those_of_differences(kinematics, angles_and_shape):
    angles, shape = angles_and_shape

    def points(step):
        joints = kinematics.pose_joints(angles + step[:26], shape + step[26:])
        return kinematics.landmarks(joints)

    _, slope = points(np.zeros(slope_size(angles_and_shape)))
    check_slope(lambda step: points(step)[0], slope)


def test_vertex_derivatives_are_those_of_differences(kinematics, angles_and_shape):
    angles, shape = angles_and_shape
    index = np.random.default_rng(1).integers(0, len(kinematics.template), 40)
    fixed = kinematics.correctives(kinematics.all_angles(angles))

    def points(step):
        joints = kinematics.pose_joints(angles + step[:26], shape + step[26:])
        return kinematics.vertices(joints, index, fixed[index])

    _, slope = points(np.zeros(slope_size(angles_and_shape)))
    check_slope(lambda step: points(step)[0], slope)


def test_image_derivatives_are_those_of_differences(kinematics, angles_and_shape):
    angles, shape = angles_and_shape
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    state = FitState(turn, np.array([0.1, -0.2, -0.5]), angles, shape, 600.0, np.array([200.0, 150.0]))

    def seen(state):
        return state.linearize(*kinematics.landmarks(kinematics.pose_joints(state.angles, state.shape)))

    slope = seen(state).d_image
    check_slope(lambda step: seen(state.moved(step)).image, slope, scale=1e3)


def slope_size(angles_and_shape):
    return len(angles_and_shape[0]) + len(angles_and_shape[1])


def check_slope(function, slope, scale=1.0):
    n = slope.shape[2]
    eye = np.eye(n) * STEP
    differences = np.stack([(function(eye[k]) - function(-eye[k])) / (2 * STEP) for k in range(n)], -1)
    # Rounding of central differences: 1e-16 * scale / STEP, and the cubic term STEP^2.
    np.testing.assert_allclose(slope, differences, atol=1e-8 * scale)
