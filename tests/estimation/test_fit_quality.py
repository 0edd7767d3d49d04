import numpy as np
import pytest
import torch

from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.estimation.fit_problem import fit_target
from oasis_warp.estimation.fit_quality import framing_warnings, keeps_quality, with_pose

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
    return framing_warnings(fit_target(FLAT, None, SIZE), mask)


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
    assert framing_warnings(fit_target(xy, None, SIZE), np.zeros(SIZE[::-1], np.float32)) == [CUT]


def test_a_left_hand_that_was_not_moved_is_worth_what_it_was(hand, fitted):
    _, _, fit = fitted("thumb_up_left_06.jpg")
    again = with_pose(hand, fit, fit.pose)
    assert abs(again.reprojection - fit.reprojection) < 0.05
    assert abs(again.mask_iou - fit.mask_iou) < 0.01
    assert keeps_quality(again, fit._replace(mask_iou=1.0, reprojection=0.0))


def test_a_hand_that_was_turned_away_misses_its_landmarks(hand, fitted):
    _, _, fit = fitted("thumb_up_left_06.jpg")
    turn = from_axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.3))
    moved = with_pose(hand, fit, fit.pose._replace(orientation=turn @ fit.pose.orientation))
    assert moved.reprojection > 3 * fit.reprojection
    assert not keeps_quality(moved, fit)
    assert keeps_quality(moved, moved)
