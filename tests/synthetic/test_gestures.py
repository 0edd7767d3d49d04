import numpy as np
import pytest
import torch

from oasis_warp.core.types import HandPose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.synthetic.body import bundled_body
from oasis_warp.synthetic.contact import bundled_skeleton, overlaps, separate
from oasis_warp.synthetic.gestures import GESTURE_NAMES, GESTURES, sample_gesture


@pytest.fixture(scope="module")
def drawn():
    """Two hundred gestures, before and after their fingers are kept apart; mean hands."""
    hand = bundled_body().hand
    rng = np.random.default_rng(0)
    names, angles = zip(*(sample_gesture(rng, hand) for _ in range(200)), strict=True)
    joints = np.repeat(hand.joints.double().numpy()[None] * 1e3, len(angles), 0)
    return names, np.stack(angles), joints


def test_gestures_stay_inside_the_joint_limits_before_and_after_they_are_kept_apart(drawn):
    _, angles, joints = drawn
    low, high = bundled_body().hand.pose_limits.double().numpy()[1:].transpose(2, 0, 1)
    for a in (angles, separate(angles, joints)[0]):
        assert (a[:, 1:] >= low - 1e-9).all() and (a[:, 1:] <= high + 1e-9).all()
        assert not a[:, 0].any()


def test_sunk_fingers_are_drawn_apart_to_within_half_a_millimetre(drawn):
    _, angles, joints = drawn
    before = overlaps(angles, joints).max(1)
    after, depth = separate(angles, joints)
    assert (before > 2).mean() > 0.2  # the grammar alone does sink fingers in
    assert depth.max() < 0.7
    np.testing.assert_allclose(overlaps(after, joints).max(1), depth)


def test_a_pose_that_touches_nothing_is_left_alone(drawn):
    _, angles, joints = drawn
    free = overlaps(angles, joints).max(1) == 0
    assert free.sum() > 40
    np.testing.assert_array_equal(separate(angles, joints)[0][free], angles[free])


def test_a_pose_does_not_depend_on_its_batch(drawn):
    _, angles, joints = drawn
    together, _ = separate(angles[:12], joints[:12])
    alone = np.concatenate([separate(angles[k : k + 1], joints[k : k + 1])[0] for k in range(12)])
    np.testing.assert_array_equal(together, alone)


def test_every_gesture_of_the_grammar_is_drawn():
    hand = bundled_body().hand
    rng = np.random.default_rng(1)
    seen = {sample_gesture(rng, hand)[0] for _ in range(1200)}
    assert seen == set(GESTURE_NAMES) == set(GESTURES)


def test_the_skeleton_of_a_batch_moves_bones_as_the_hand_model_does():
    hand = bundled_body().hand
    _, angles = sample_gesture(np.random.default_rng(3), hand)
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names)))
    pose = HandPose(torch.from_numpy(angles[1:]).float(), torch.eye(3), torch.zeros(3))
    wanted = skin(hand, rest, pose).joints
    joints = hand.joints.double().numpy()
    rotation, shift = bundled_skeleton().transforms(angles[None], joints[None])
    found = (rotation[0] @ joints[..., None])[..., 0] + shift[0]
    np.testing.assert_allclose(found, wanted.numpy(), atol=1e-6)
