from statistics import median

import numpy as np
import pytest
import torch

from oasis_warp.core.types import HandPose, PosedHand
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import rest_hand, skin


@pytest.fixture(scope="module")
def rests(hand):
    """Hands of other shapes."""
    shapes = np.random.default_rng(3).normal(size=(6, len(hand.shape_names)))
    return [rest_hand(hand, torch.from_numpy(shape).float()) for shape in shapes]


@pytest.fixture(scope="module")
def mean_rest(hand):
    return rest_hand(hand, torch.zeros(len(hand.shape_names)))


def gap(hand, rest, angles, *bones):
    """Distance between the skin of two bones."""
    vertices = skin(hand, rest, HandPose(angles, torch.eye(3), torch.zeros(3))).vertices
    one, other = (vertices[hand.segment == hand.joint_names.index(bone)] for bone in bones)
    return float(torch.cdist(one, other).min())


@pytest.mark.parametrize("name", POSE_NAMES)
def test_the_mean_hand_takes_named_poses_as_they_stand_in_the_table(hand, mean_rest, name):
    torch.testing.assert_close(named_pose(hand, name, mean_rest), named_pose(hand, name), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["pinch", "ok"])
def test_thumb_and_index_meet_on_hands_of_other_shapes(hand, rests, mean_rest, name):
    tips = "thumb3", "index3"
    expected = gap(hand, mean_rest, named_pose(hand, name), *tips)
    plain = [gap(hand, rest, named_pose(hand, name), *tips) for rest in rests]
    made = [gap(hand, rest, named_pose(hand, name, rest), *tips) for rest in rests]
    assert max(plain) > expected + 0.003  # the table's angles leave them apart
    assert max(made) < expected + 0.001


def test_fingers_of_a_fist_lie_as_close_as_on_the_mean_hand(hand, rests, mean_rest):
    for pair in [("index2", "middle2"), ("middle2", "ring2"), ("ring2", "little2")]:
        expected = gap(hand, mean_rest, named_pose(hand, "fist"), *pair)
        made = [gap(hand, rest, named_pose(hand, "fist", rest), *pair) for rest in rests]
        assert median(made) < expected + 0.0005 and max(made) < expected + 0.002, pair


@pytest.mark.parametrize("name", ["fist", "victory", "ok"])
def test_angles_stay_within_limits_and_near_the_table(hand, rests, name):
    table, limits = named_pose(hand, name), hand.pose_limits[1:]
    for rest in rests:
        angles = named_pose(hand, name, rest)
        assert 0 < (angles - table).abs().max().rad2deg() < 30
        assert (angles >= torch.minimum(limits[..., 0], table) - 1e-6).all()
        assert (angles <= torch.maximum(limits[..., 1], table) + 1e-6).all()


def test_straight_fingers_stay_as_they_are(hand, rests):
    table = named_pose(hand, "open")
    assert all(torch.equal(named_pose(hand, "open", rest), table) for rest in rests)


def test_a_hand_of_mano_touches_as_the_bundled_one(mano):
    rest = rest_hand(mano, torch.zeros(mano.shape_basis.shape[2]))
    tips = "thumb3", "index3"
    assert gap(mano, rest, named_pose(mano, "ok", rest), *tips) < 0.002


@pytest.mark.gpu
def test_a_hand_on_the_device_takes_the_same_pose(hand, rests):
    there = named_pose(hand.to("cuda"), "ok", PosedHand(*(part.cuda() for part in rests[0])))
    torch.testing.assert_close(there.cpu(), named_pose(hand, "ok", rests[0]))
