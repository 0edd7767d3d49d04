import cv2
import numpy as np
import pytest

from oasis_warp.core.hand_model import KNUCKLES
from oasis_warp.estimation.fit_problem import pixels_per_metre
from oasis_warp.estimation.landmarks import Crop, read_crop
from oasis_warp.estimation.networks import drawn_hand, networks
from oasis_warp.estimation.segmentation import mask_from_alpha, mask_from_fit, mask_from_landmarks


@pytest.fixture(scope="module")
def drawing():
    """A drawn hand, so that the mask is known: picture, landmarks, pixels a metre, true mask of hand and arm."""
    picture = drawn_hand(224)
    seen = read_crop(picture, networks(), Crop(np.array([112.0, 112.0]), 224.0, 0.0))
    truth = picture[..., 0].astype(int) > picture[..., 2]  # skin is red, the ground blue
    return picture, seen.xy, pixels_per_metre(seen.xy, seen.world), truth


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


def hand_side(xy, shape):
    up = xy[KNUCKLES].mean(0) - xy[0]
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    return (x - xy[0, 0]) * up[0] + (y - xy[0, 1]) * up[1]


def test_the_mask_is_the_drawn_hand(drawing):
    picture, xy, scale, truth = drawing
    mask = mask_from_landmarks(picture, xy, scale)
    above = hand_side(xy, truth.shape) > 0
    assert iou((mask > 0.5) & above, truth & above) > 0.97
    assert mask.min() >= 0
    assert mask.max() <= 1


def test_the_arm_is_cut_a_little_below_the_wrist(drawing):
    picture, xy, scale, truth = drawing
    mask = mask_from_landmarks(picture, xy, scale)
    up = np.linalg.norm(xy[KNUCKLES].mean(0) - xy[0])
    below = hand_side(xy, truth.shape) / up  # pixels beyond the wrist
    assert (truth & (below < -0.03 * scale)).any(), "there is an arm to cut"
    assert mask[below < -0.03 * scale].max() < 0.1
    assert mask[truth & (below > -0.01 * scale) & (below < 0)].mean() > 0.9


def test_a_mask_follows_its_photo(drawing):
    picture, xy, scale, _ = drawing
    wide = cv2.copyMakeBorder(picture, 40, 60, 70, 30, cv2.BORDER_REPLICATE)
    inner = mask_from_landmarks(wide, xy + np.array([70, 40]), scale)[40:-60, 70:-30]
    assert iou(inner > 0.5, mask_from_landmarks(picture, xy, scale) > 0.5) > 0.98


def test_a_large_photo_gives_a_mask_of_its_own_size(drawing):
    picture, xy, scale, truth = drawing
    large = cv2.resize(picture, None, fx=5, fy=5, interpolation=cv2.INTER_CUBIC)
    mask = mask_from_landmarks(large, xy * 5, scale * 5)
    assert mask.shape == (1120, 1120)
    small = cv2.resize(mask, (224, 224), interpolation=cv2.INTER_AREA)
    above = hand_side(xy, truth.shape) > 0
    assert iou((small > 0.5) & above, truth & above) > 0.97


def test_the_second_cut_takes_a_leak_away_and_fills_a_bite(drawing):
    picture, xy, scale, truth = drawing
    mesh = (truth & (hand_side(xy, truth.shape) > 0)).astype(np.uint8) * 255
    mask = mask_from_landmarks(picture, xy, scale)
    spoilt = mask.copy()
    spoilt[:30, :60] = 1.0
    palm = xy[[0, *KNUCKLES]].mean(0).astype(int)
    spoilt[palm[1] - 6 : palm[1] + 6, palm[0] - 6 : palm[0] + 6] = 0.0
    again = mask_from_fit(picture, xy, scale, spoilt, mesh)
    above = hand_side(xy, truth.shape) > 0
    assert iou((again > 0.5) & above, truth & above) > 0.97


def test_fingers_that_touch_in_the_mesh_but_not_in_the_photo_stay_apart(drawing):
    picture, xy, scale, truth = drawing
    above = hand_side(xy, truth.shape) > 0
    wide = int(0.012 * scale)
    mesh = cv2.morphologyEx((truth & above).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((wide, wide))) * 255
    slits = (mesh > 0) & ~truth & above
    assert slits.sum() > 40
    again = mask_from_fit(picture, xy, scale, truth.astype(np.float32), mesh)
    assert (again[slits] > 0.5).mean() < 0.1


def test_masks_are_repeatable(drawing):
    picture, xy, scale, _ = drawing
    np.testing.assert_array_equal(mask_from_landmarks(picture, xy, scale), mask_from_landmarks(picture, xy, scale))


def test_the_cut_out_of_a_hand_is_its_mask_without_the_arm(drawing):
    _, xy, scale, truth = drawing
    mask = mask_from_alpha(truth.astype(np.float32), xy, scale)
    assert mask is not None
    above = hand_side(xy, truth.shape) > 0
    np.testing.assert_array_equal(mask[above], truth[above])
    assert mask[-10:].max() == 0


@pytest.mark.parametrize("case", ["a whole person", "half of the hand", "nothing"])
def test_a_cut_out_that_is_not_of_this_hand_is_left_aside(drawing, case):
    _, xy, scale, truth = drawing
    left = np.arange(truth.shape[1]) < xy[9, 0]
    alpha = {"a whole person": np.ones_like(truth), "half of the hand": truth & left, "nothing": truth & False}[case]
    assert mask_from_alpha(alpha.astype(np.float32), xy, scale) is None


def test_skin_that_sticks_out_of_the_fitted_mesh_is_no_hand(drawing):
    picture, xy, scale, truth = drawing
    mesh = (truth & (hand_side(xy, truth.shape) > 0)).astype(np.uint8) * 255
    x, y = xy[KNUCKLES].mean(0).astype(int)
    bar = np.zeros_like(truth)
    bar[y - 8 : y + 8, x:] = True  # somebody else's finger beside the palm
    joined = picture.copy()
    joined[bar] = np.median(picture[truth], axis=0)
    away = cv2.distanceTransform((mesh == 0).astype(np.uint8), cv2.DIST_L2, 5) / scale  # [m]
    assert (bar & (away > 0.02)).sum() > 200
    again = mask_from_fit(joined, xy, scale, (truth | bar).astype(np.float32), mesh)
    assert again[bar & (away > 0.012)].max() < 0.1
