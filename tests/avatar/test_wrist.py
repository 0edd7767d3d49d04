"""The arm that continues the hand."""

import math

import torch

from oasis_warp.avatar.wrist import BEFORE_RIM, arm_axis, fading_arm, rim_axis


def test_the_arm_goes_half_way_from_the_rims_normal_to_the_skins_direction(hand):
    """Along the normal of a rim that is cut aslant, the arm turned back from the palm and stood on it with a step."""
    normal, along = rim_axis(hand.template, hand.rim), arm_axis(hand.template, hand.rim)
    assert 7 < math.degrees(math.acos(float(normal @ along))) < 10  # half of 17
    assert along[1] < normal[1]  # towards the palm


def test_the_arm_leaves_the_rim_as_the_skin_reaches_it(hand):
    """Straight from the rim on, it turned by up to 24 degrees, a step in outlines at the wrist."""
    rest, rim = hand.template, hand.rim
    axis, middle = arm_axis(rest, rim), rest[rim].mean(0)
    index, offsets, *_ = fading_arm(rest, rim)
    outside = offsets.norm(dim=1) < 0.006  # of the balls inside none is near
    arm, skin = (rest[index] + offsets)[outside], rest[torch.cdist(rest, rest[rim]).amin(1) < BEFORE_RIM]

    def outlines(points):
        """Where they lie around the axis, along it, and how far from it."""
        along = (points - middle) @ axis
        away = points - middle - along[:, None] * axis
        return away / away.norm(dim=1, keepdim=True), along, away.norm(dim=1)

    turns = []
    for at in outlines(rest[rim])[0]:
        slopes = []
        for around, along, radius in map(outlines, (skin, arm)):
            near = (around @ at > math.cos(0.2)).double()
            rows = torch.stack([torch.ones_like(near), along.double()], 1)
            line = torch.linalg.lstsq(rows * near[:, None], (radius.double() * near)[:, None]).solution
            slopes.append(math.degrees(math.atan(float(line[1]))))
        turns.append(abs(slopes[1] - slopes[0]))
    assert sorted(turns)[int(0.9 * len(turns))] < 11  # of 15 along one axis
