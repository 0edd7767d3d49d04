import numpy as np
import pytest
import torch

from oasis_warp.estimation.surface_state import shape_of, state_of_surface
from oasis_warp.hand.poses import named_pose


@pytest.fixture(scope="module")
def known(hand, kinematics):
    """A state, its rest surface and its posed surface."""
    random = np.random.default_rng(0)
    shape = random.normal(size=len(hand.shape_names))
    angles = named_pose(hand, "fist").numpy().astype(np.float64)[kinematics.dofs[:, 0] - 1, kinematics.dofs[:, 1]]
    rest = kinematics.rest_surface(shape)
    start = state_of_surface(kinematics, shape, rest, rest + np.array([0, 0, 0.5]), 500.0, np.array([64.0, 64.0])).state
    state = start.moved(np.r_[0.4, -0.2, 0.3, 0.1, 0.05, 0.1, angles, np.zeros(len(shape) + 1)])
    posed = state.in_camera(kinematics.surface(kinematics.pose_joints(state.angles, shape)))
    return state, rest, posed


def test_a_surface_of_the_model_gives_back_its_state(kinematics, known):
    state, rest, posed = known
    shape = shape_of(kinematics, rest)
    found, detail = state_of_surface(kinematics, shape, rest, posed, state.focal, state.centre)
    assert np.abs(shape - state.shape).max() < 0.2
    assert np.degrees(np.abs(found.angles - state.angles)).max() < 2
    assert np.abs(found.rotation - state.rotation).max() < 0.02
    assert np.linalg.norm(detail, axis=1).max() < 1e-3


def test_with_its_detail_the_model_is_the_surface(kinematics, known):
    state, rest, posed = known
    bumps = torch.randn(len(posed), 3, generator=torch.Generator().manual_seed(1)).numpy() * 1e-3
    found, detail = state_of_surface(kinematics, state.shape, rest, posed + bumps, state.focal, state.centre)
    joints = kinematics.pose_joints(found.angles, found.shape)
    bare = kinematics.rest_surface(found.shape) + kinematics.correctives(kinematics.all_angles(found.angles))
    again = found.in_camera(kinematics.pose_surface(joints, bare + detail))
    assert np.abs(again - posed - bumps).max() < 1e-9
