import numpy as np
import pytest

from oasis_warp.estimation.fit_target import evidence_of
from oasis_warp.estimation.fit_warnings import framing_warnings

CUT = "the hand is cut by the photo's border: what lies outside is guessed"
SIZE = 401, 301
FINGERS = [[150.0 + 25 * finger, 200.0 - 35 * bone] for finger in range(5) for bone in range(4)]
FLAT = np.array([[200.0, 270.0], *FINGERS])
"""Landmarks of a hand that lies well inside of the photo."""


def warnings_with(*rows_and_columns):
    mask = np.zeros(SIZE[::-1], np.float32)
    mask[80:250, 140:270] = 1
    for part in rows_and_columns:
        mask[part] = 1
    return framing_warnings(evidence_of(FLAT, None, SIZE), mask)


def test_a_hand_inside_of_the_photo_is_not_cut():
    assert warnings_with() == []


@pytest.mark.parametrize(
    "part",
    [
        (slice(0, 80), slice(150, 190)),
        (slice(100, 140), slice(0, 140)),
        (slice(100, 140), slice(270, None)),
    ],
    ids=["top", "left", "right"],
)
def test_a_hand_that_reaches_a_border_is_cut(part):
    assert warnings_with(part) == [CUT]


def test_an_arm_may_leave_the_photo():
    assert warnings_with((slice(270, None), slice(150, 260))) == []


@pytest.mark.parametrize("outside", [(-1.0, 100.0), (402.0, 100.0), (200.0, -1.0), (200.0, 302.0)])
def test_a_landmark_outside_of_the_photo_is_a_cut_hand(outside):
    xy = FLAT.copy()
    xy[8] = outside
    assert framing_warnings(evidence_of(xy, None, SIZE), np.zeros(SIZE[::-1], np.float32)) == [CUT]
