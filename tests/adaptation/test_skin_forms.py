"""What is wide on skin: relief, blotches of blood, red joints and fingertips."""

import torch

from oasis_warp.adaptation.skin_forms import flush_shade, joint_shade, relief, relief_shade
from oasis_warp.avatar.appearance import label_regions
from oasis_warp.core.hand_model import finger_of
from oasis_warp.hand.template import bundled_hand

MIDDLE, RING = 4, 10
"""First joints of these fingers."""


def test_knuckles_and_pads_stand_out_of_unseen_skin():
    """Painted hands were slabs: detail of 4 to 8 px, where tendons and pads are, was at .4 of real hands'."""
    hand = bundled_hand()
    palm = label_regions(hand).palm
    first, other = (relief(hand, seed) for seed in (0, 1))
    at_knuckle = (hand.template - hand.joints[MIDDLE]).norm(dim=1)
    knuckle = first[(at_knuckle < 0.015) & (palm < 0.05)].max()
    between = first[(hand.template - hand.joints[[RING, MIDDLE]].mean(0)).norm(dim=1) < 0.015].min()
    assert float(knuckle) > 0.2 and float(between) < -0.2
    on_palm = first[palm > 0.999]
    assert float(on_palm.max()) > 0.3 and -0.36 < float(on_palm.min()) < -0.3
    assert not torch.equal(first, other) and torch.equal(first, relief(hand, 0))


def test_blotches_of_blood_are_a_seeds_own_and_strongest_on_the_palm():
    hand = bundled_hand()
    palm = label_regions(hand).palm
    first, other = (flush_shade(hand, seed)[:, 1] for seed in (0, 1))
    assert not torch.equal(first, other)
    assert 0.03 < float(first[palm > 0.999].std()) < 0.05
    assert float(first.mean().abs()) < 0.005


def test_no_finger_is_redder_than_another():
    """Blotches as wide as fingers made one finger of every hand pale and the next one red."""
    hand = bundled_hand()
    finger, palm = torch.from_numpy(finger_of(hand.segment.numpy())), label_regions(hand).palm > 0.95
    for seed in range(3):
        blood = flush_shade(hand, seed)[:, 1]
        means = torch.stack([blood[palm & (finger == k)].mean() for k in range(1, 6)])
        assert float(means.max() - means.min()) < 0.015


def test_joints_and_fingertips_are_darker_and_redder_than_the_bones_between_them(hand):
    """Backs of painted fingers had one colour; a photo's have dark red joints and tips."""
    shade = joint_shade(hand)
    palm = label_regions(hand).palm
    assert float(shade[(palm > 0.999) & (hand.segment == 0)].min()) > -0.01 and float(shade.max()) <= 0
    finger = finger_of(hand.segment) == finger_of(MIDDLE)
    on_bone = {at: finger & (hand.segment == MIDDLE + at) & (palm < 0.05) for at in range(3)}
    between = shade[on_bone[1] & ((hand.bone_t - 0.55).abs() < 0.1)].mean(0)
    for joint in (shade[on_bone[at] & (hand.bone_t < 0.1)].mean(0) for at in (1, 2)):
        assert float((joint - between).mean()) < -0.012
        assert float(joint[0] - joint[1]) > float(between[0] - between[1]) + 0.01
    for side in (palm < 0.05, palm > 0.95):
        tip = shade[finger & (hand.segment == MIDDLE + 2) & side & (hand.bone_t > 0.6)].mean(0)
        assert float(tip[0] - tip[1]) > 0.03


def test_pads_of_fingers_are_as_bright_as_their_joints(hand):
    """Relief made pads pale between dark bands."""
    shade = relief_shade(hand, 0).mean(1)
    pads = (hand.segment == MIDDLE + 1) & (label_regions(hand).palm > 0.99)
    assert 0.01 < float(shade[pads].max() - shade[pads].min()) < 0.1
    palm = (hand.segment == 0) & (label_regions(hand).palm > 0.99)
    assert float(shade[palm].max() - shade[palm].min()) > 0.2
