"""What is hand in a picture, also against masks drawn by hand."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import KNUCKLES
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.fit_problem import pixels_per_metre
from oasis_warp.estimation.landmarks import Crop, read_crop
from oasis_warp.estimation.networks import drawn_hand, networks
from oasis_warp.estimation.pixel_reading import SIDE, PixelReading
from oasis_warp.estimation.segmentation import mask_from_alpha, mask_from_reading
from oasis_warp.network.dense_network import ARM, FRONT, HAND
from studies.inputs import PHOTOS, _filled, mask_name, read_masks


def hand_side(xy, shape):
    """Distance of pixels from the wrist point towards the knuckles [px]."""
    up = xy[KNUCKLES].mean(0) - xy[0]
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    return ((x - xy[0, 0]) * up[0] + (y - xy[0, 1]) * up[1]) / np.linalg.norm(up)


def reading_of(hand, arm, front=None):
    """What a network says that sees these masks of a photo, a little blurred."""
    scale = SIDE / len(hand)
    shares = np.zeros((4, SIDE, SIDE), np.float32)
    for row, mask in ((HAND, hand), (ARM, arm), (FRONT, np.zeros_like(hand) if front is None else front)):
        shares[row] = cv2.GaussianBlur(cv2.resize(mask.astype(np.float32), (SIDE, SIDE)), (0, 0), 1.5)
    shares[0] = 1 - shares[1:].sum(0)
    nothing = np.zeros((6, SIDE, SIDE), np.float32)
    three, image = nothing[:3], np.zeros((SIDE, SIDE, 3), np.uint8)
    return PixelReading(np.zeros(2), scale, image, shares, three, nothing[0], three, three, nothing)


@pytest.fixture(scope="module")
def drawing():
    """A drawn hand, so that the mask is known: picture, landmarks, pixels a metre, true masks of hand and of arm."""
    picture = drawn_hand(224)
    seen = read_crop(picture, networks(), Crop(np.array([112.0, 112.0]), 224.0, 0.0))
    skin = picture[..., 0].astype(int) > picture[..., 2]  # the ground is blue
    above = hand_side(seen.xy, skin.shape) > 0
    return picture, seen.xy, pixels_per_metre(seen.xy, seen.world), skin & above, skin & ~above


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("change", [("__version__", "4.11.0"), ("ximgproc", SimpleNamespace())])
def test_another_opencv_over_ours_is_told_before_any_work(hand, monkeypatch, change):
    monkeypatch.setattr(cv2, *change)
    with pytest.raises(InputError, match=r"another OpenCV package.*pip uninstall -y opencv-python .*--force-reinstall"):
        HandEstimator(hand)


def test_the_mask_is_the_hand_without_the_arm(drawing):
    picture, xy, _, hand, arm = drawing
    mask = mask_from_reading(picture, reading_of(hand, arm), xy)
    assert iou(mask > 0.5, hand) > 0.98
    assert mask.dtype == np.float32
    assert 0 <= mask.min() < mask.max() <= 1


@pytest.mark.parametrize("grown", [-3, 3])
def test_the_mask_follows_the_edges_of_the_photo_where_the_network_is_a_little_off(drawing, grown):
    picture, xy, _, hand, arm = drawing
    change = cv2.dilate if grown > 0 else cv2.erode
    coarse = change(hand.astype(np.uint8), np.ones((abs(grown), abs(grown)))) > 0
    seen = reading_of(coarse & ~arm, arm)
    before = iou(seen.in_photo(seen.hand, (224, 224)) > 0.5, hand)
    assert 1 - iou(mask_from_reading(picture, seen, xy) > 0.5, hand) < 0.4 * (1 - before)


def test_slits_between_fingers_stay_open(drawing):
    picture, xy, _, hand, arm = drawing
    slits = (cv2.morphologyEx(hand.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((15, 15))) > 0) & ~hand & ~arm
    assert slits.sum() > 40
    mask = mask_from_reading(picture, reading_of(hand, arm), xy)
    assert (mask[slits] > 0.5).mean() < 0.1


def test_a_finger_that_the_dense_network_doubts_is_taken_where_landmarks_have_seen_it(drawing):
    picture, xy, _, hand, arm = drawing
    reading = reading_of(hand, arm)
    y, x = np.mgrid[0:SIDE, 0:SIDE] / reading.scale
    base, tip = xy[18], xy[20]
    little = (np.stack([x - base[0], y - base[1]], -1) @ (tip - base) > 0) & (np.hypot(x - tip[0], y - tip[1]) < 60)
    doubted = reading.shares.copy()
    doubted[HAND][little] *= 0.05
    doubted[0] = 1 - doubted[1:].sum(0)
    mask = mask_from_reading(picture, replace(reading, shares=doubted), xy)
    row, column = np.round(xy[19]).astype(int)[::-1]
    assert mask[row, column] > 0.5
    assert iou(mask > 0.5, hand) > 0.96


def test_a_thing_in_front_of_the_hand_is_left_out_although_it_has_the_colour_of_skin(drawing):
    picture, xy, _, hand, arm = drawing
    x, y = xy[KNUCKLES].mean(0).astype(int)
    bar = np.zeros_like(hand)
    bar[y - 8 : y + 8, x:] = True  # somebody else's finger
    joined = picture.copy()
    joined[bar] = np.median(picture[hand], axis=0)
    mask = mask_from_reading(joined, reading_of(hand & ~bar, arm, bar), xy)
    assert mask[cv2.erode(bar.astype(np.uint8), np.ones((9, 9))) > 0].max() < 0.1
    assert iou(mask > 0.5, hand & ~bar) > 0.95


def test_a_large_photo_gives_a_mask_of_its_own_size(drawing):
    picture, xy, _, hand, arm = drawing
    large = cv2.resize(picture, None, fx=5, fy=5, interpolation=cv2.INTER_CUBIC)
    seen = reading_of(hand, arm)
    mask = mask_from_reading(large, replace(seen, scale=seen.scale / 5), xy * 5)
    assert mask.shape == (1120, 1120)
    assert iou(cv2.resize(mask, (224, 224), interpolation=cv2.INTER_AREA) > 0.5, hand) > 0.97


def test_the_mask_of_a_tiny_hand_follows_the_edges_too(drawing):
    """Every fourth row and column of it has too few sure pixels for colour models."""
    picture, xy, _, hand, arm = drawing
    small = cv2.resize(picture, (32, 32), interpolation=cv2.INTER_AREA)
    little, beside = (
        cv2.resize(mask.astype(np.float32), (32, 32), interpolation=cv2.INTER_AREA) > 0.5 for mask in (hand, arm)
    )
    coarse = cv2.dilate(little.astype(np.uint8), np.ones((3, 3))) > 0
    seen = reading_of(coarse & ~beside, beside)
    before = iou(seen.in_photo(seen.hand, (32, 32)) > 0.5, little)
    assert iou(mask_from_reading(small, seen, xy / 7) > 0.5, little) > before + 0.05


def test_masks_are_repeatable(drawing):
    picture, xy, _, hand, arm = drawing
    first, second = (mask_from_reading(picture, reading_of(hand, arm), xy) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_photo_without_a_hand_has_an_empty_mask(drawing):
    picture, xy, _, hand, _ = drawing
    nothing = np.zeros_like(hand)
    assert mask_from_reading(picture, reading_of(nothing, nothing), xy).max() < 0.5


def test_the_cut_out_of_a_hand_is_its_mask_without_the_arm(drawing):
    _, xy, scale, hand, arm = drawing
    mask = mask_from_alpha((hand | arm).astype(np.float32), reading_of(hand, arm), xy, scale)
    assert mask is not None
    np.testing.assert_array_equal(mask[hand], 1)
    assert mask[~(hand | arm)].max() == 0
    past = -hand_side(xy, hand.shape)
    assert (arm & (past > 0.03 * scale)).any(), "there is an arm to cut"
    assert mask[past > 0.03 * scale].max() == 0
    assert mask[arm & (past < 0.01 * scale)].min() == 1


@pytest.mark.parametrize("case", ["a whole person", "half of the hand", "nothing"])
def test_a_cut_out_that_is_not_of_this_hand_is_left_aside(drawing, case):
    _, xy, scale, hand, arm = drawing
    left = np.arange(hand.shape[1]) < xy[9, 0]
    alpha = {"a whole person": np.ones_like(hand), "half of the hand": hand & left, "nothing": hand & False}[case]
    assert mask_from_alpha(alpha.astype(np.float32), reading_of(hand, arm), xy, scale) is None


ROOT = Path(__file__).parents[2]
OUTLINES = ROOT / "tests/data/masks/outlines.json"
ENTRIES = json.loads(OUTLINES.read_text(encoding="utf-8"))

every_photo = pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: mask_name(e["file"]))


def write(tmp_path, polygons, wrist=((0.0, 0.0), (8.0, 0.0))):
    path = tmp_path / "outlines.json"
    path.write_text(json.dumps([{"file": "a.png", "size": [8, 6], "polygons": polygons, "wrist": wrist, "note": ""}]))
    return path


def polygons_of(entry, kind):
    return [np.array(p[kind]) for p in entry["polygons"] if kind in p]


def edge_crossings(points):
    """Pairs of edges of a closed polygon, not neighbours, that cross or touch; edges in one line do not count."""
    start, end = points, np.roll(points, -1, axis=0)

    def turns(of):  # [i, j]: to which side of edge i point j of `of` lies
        along, to = (end - start)[:, None], of[None] - start[:, None]
        return np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    first, second = turns(start), turns(end)
    meet = (first * second <= 0) & (first.T * second.T <= 0) & ((first != 0) | (second != 0))
    i, j = np.nonzero(meet)
    apart = (i - j) % len(points)
    return [(int(p), int(q)) for p, q, d in zip(i, j, apart, strict=True) if 1 < d < len(points) - 1]


@pytest.fixture(scope="module")
def masks():
    return read_masks(OUTLINES)


@pytest.fixture(scope="module")
def hands():
    return read_masks(OUTLINES, cut_at_wrist=True)


def test_fifteen_photos_are_outlined_each_once(masks):
    assert len(ENTRIES) == 15
    assert list(masks) == sorted(mask_name(e["file"]) for e in ENTRIES)


@every_photo
def test_an_outline_has_the_size_of_its_photo(entry):
    height, width = read_photo(ROOT / PHOTOS / entry["file"]).rgb.shape[:2]
    assert entry["size"] == [width, height]


def test_a_figure_eight_is_found_to_cross_itself_and_a_square_with_straight_joints_is_not():
    assert edge_crossings(np.array([[0.0, 0], [2, 2], [2, 0], [0, 2]])) != []
    assert edge_crossings(np.array([[0.0, 0], [1, 0], [2, 0], [3, 0], [3, 3], [0, 3]])) == []


@every_photo
def test_an_outline_is_one_closed_line_that_does_not_cross_itself(entry):
    assert len(polygons_of(entry, "outer")) == 1
    for kind in ("outer", "hole"):
        for points in polygons_of(entry, kind):
            assert edge_crossings(points) == []
            assert np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1).min() > 0


@every_photo
def test_an_outline_stays_within_its_photo(entry):
    for kind in ("outer", "hole"):
        for points in polygons_of(entry, kind):
            assert (points >= 0).all() and (points <= entry["size"]).all()


@pytest.mark.parametrize("name", ["ok_sign_left_10", "back_flat_right_04", "same_hand/b1_panel_right/03_o_shape"])
def test_holes_lie_inside_the_outline_and_are_uncovered(name, masks):
    (entry,) = (e for e in ENTRIES if mask_name(e["file"]) == name)
    (outer,), (hole,) = (
        [_filled(points, masks[name].shape) for points in polygons_of(entry, kind)]
        for kind in ("outer", "hole")
    )
    assert hole.sum() > 100 and outer[hole].all()
    assert masks[name][hole].mean() < 0.1  # only the pixels its edge runs through are covered in part


@every_photo
def test_the_hand_covers_a_plausible_share_of_its_photo_and_most_of_what_was_drawn(entry, masks, hands):
    name = mask_name(entry["file"])
    whole, hand = masks[name], hands[name]
    assert whole.shape == hand.shape == tuple(entry["size"][::-1])
    assert 0.1 < hand.mean() < 0.5
    assert 0.6 < hand.sum() / whole.sum() <= 1  # the wrong end of the wrist line first would keep the forearm


@every_photo
def test_the_wrist_line_ends_at_the_outline(entry):
    a = polygons_of(entry, "outer")[0]
    ab = np.roll(a, -1, axis=0) - a
    for end in entry["wrist"]:
        t = np.clip(((end - a) * ab).sum(1) / (ab**2).sum(1), 0, 1)
        assert np.linalg.norm(a + t[:, None] * ab - end, axis=1).min() < 4


def test_coverage_is_the_share_of_a_pixel_inside(tmp_path):
    outer = [[1, 1], [5.5, 1], [5.5, 4.25], [1, 4.25]]
    path = write(tmp_path, [{"outer": outer}, {"hole": [[2, 2], [3, 2], [3, 3], [2, 3]]}])
    expected = np.zeros((6, 8), np.float32)
    expected[1:4, 1:5] = 1
    expected[1:4, 5] = 0.5
    expected[4, 1:5] = 0.25
    expected[4, 5] = 0.125
    expected[2, 2] = 0
    np.testing.assert_array_equal(read_masks(path)["a"], expected)


@pytest.mark.parametrize("turn", [1, -1], ids=["clockwise", "anticlockwise"])
def test_a_slanted_outline_covers_its_area_whichever_way_it_was_drawn(tmp_path, turn):
    triangle = [[0.3, 0.4], [7.6, 1.7], [2.9, 5.8]][::turn]
    (x0, y0), (x1, y1), (x2, y2) = triangle
    area = abs((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)) / 2
    assert read_masks(write(tmp_path, [{"outer": triangle}]))["a"].sum() == pytest.approx(area, abs=0.15)


def test_the_cut_keeps_what_lies_to_the_left_of_the_walk_along_the_wrist(tmp_path):
    full = [{"outer": [[0, 0], [8, 0], [8, 6], [0, 6]]}]
    up = read_masks(write(tmp_path, full, wrist=[[0, 4], [8, 4]]), cut_at_wrist=True)["a"]
    assert up[:4].all() and not up[4:].any()
    down = read_masks(write(tmp_path, full, wrist=[[8, 4], [0, 4]]), cut_at_wrist=True)["a"]
    assert down[4:].all() and not down[:4].any()


def test_a_polygon_of_an_unknown_kind_is_refused(tmp_path):
    with pytest.raises(ValueError, match='expected a polygon "outer" or "hole", got "inner"'):
        read_masks(write(tmp_path, [{"inner": [[0, 0], [1, 0], [1, 1]]}]))
