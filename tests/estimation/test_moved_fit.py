import torch

from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.estimation.moved_fit import keeps_quality, with_pose


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
