import numpy as np
import pytest
import torch

from oasis_warp.core.types import HandPose
from oasis_warp.estimation.fit_problem import FitState
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.skinning import rest_hand, skin

STEP = 1e-6


@pytest.fixture(scope="module")
def kinematics(hand):
    return HandKinematics(hand)


@pytest.fixture
def bent(kinematics):
    rng = np.random.default_rng(3)
    return rng.uniform(-0.3, 1.2, len(kinematics.dofs)), rng.normal(size=kinematics.shape_basis.shape[2])


def test_surface_is_that_of_skinning_with_its_correctives(hand, kinematics, bent):
    angles, shape = bent
    table = kinematics.all_angles(angles)
    pose = HandPose(torch.from_numpy(table[1:]).float(), torch.eye(3), torch.zeros(3))
    posed = skin(hand, rest_hand(hand, torch.from_numpy(shape).float()), pose)
    joints = kinematics.pose_joints(angles, shape)
    # float32 of a hand of 0.2 m
    np.testing.assert_allclose(kinematics.surface(joints), posed.vertices, atol=3e-7)
    np.testing.assert_allclose(joints.position, posed.joints, atol=3e-7)


def test_landmark_derivatives_are_those_of_differences(kinematics, bent):
    angles, shape = bent

    def points(step):
        joints = kinematics.pose_joints(angles + step[:26], shape + step[26:])
        return kinematics.landmarks(joints)

    _, slope = points(np.zeros(slope_size(bent)))
    check_slope(lambda step: points(step)[0], slope)


def test_vertex_derivatives_are_those_of_differences(kinematics, bent):
    angles, shape = bent
    index = np.random.default_rng(1).integers(0, len(kinematics.template), 40)
    fixed = kinematics.correctives(kinematics.all_angles(angles))

    def points(step):
        joints = kinematics.pose_joints(angles + step[:26], shape + step[26:])
        return kinematics.vertices(joints, index, fixed[index])

    _, slope = points(np.zeros(slope_size(bent)))
    check_slope(lambda step: points(step)[0], slope)


def test_image_derivatives_are_those_of_differences(kinematics, bent):
    angles, shape = bent
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    state = FitState(turn, np.array([0.1, -0.2, -0.5]), angles, shape, 600.0, np.array([200.0, 150.0]))

    def seen(state):
        return state.linearize(*kinematics.landmarks(kinematics.pose_joints(state.angles, state.shape)))

    slope = seen(state).d_image
    check_slope(lambda step: seen(state.moved(step)).image, slope, scale=1e3)


def slope_size(bent):
    return len(bent[0]) + len(bent[1])


def check_slope(function, slope, scale=1.0):
    n = slope.shape[2]
    eye = np.eye(n) * STEP
    differences = np.stack([(function(eye[k]) - function(-eye[k])) / (2 * STEP) for k in range(n)], -1)
    # Rounding of central differences: 1e-16 * scale / STEP, and the cubic term STEP^2.
    np.testing.assert_allclose(slope, differences, atol=1e-8 * scale)
