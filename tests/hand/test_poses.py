"""Named poses look like their names, keep the limits, and follow each other smoothly."""

import pytest
import torch
from hand_build.quality import self_crossings

from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import POSE_NAMES, named_pose, pose_sequence
from oasis_warp.hand.skinning import hand21, rest_hand, skin


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
