"""The arm that continues the hand."""

import math

from oasis_warp.avatar.wrist import arm_axis, rim_axis


def test_the_arm_goes_half_way_from_the_rims_normal_to_the_skins_direction(hand):
    """Along the normal of a rim that is cut aslant, the arm turned back from the palm and stood on it with a step."""
    normal, along = rim_axis(hand.template, hand.rim), arm_axis(hand.template, hand.rim)
    assert 7 < math.degrees(math.acos(float(normal @ along))) < 10  # half of 17
    assert along[1] < normal[1]  # towards the palm
