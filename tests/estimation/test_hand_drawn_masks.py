import json
from pathlib import Path

import numpy as np
import pytest

from studies.inputs import _filled, read_masks

ROOT = Path(__file__).parents[2]
OUTLINES = ROOT / "tests/data/masks/outlines.json"
ENTRIES = json.loads(OUTLINES.read_text(encoding="utf-8"))

every_photo = pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: Path(e["file"]).stem)


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


def test_ten_photos_are_outlined_each_once(masks):
    assert len(ENTRIES) == 10
    assert list(masks) == sorted(Path(e["file"]).stem for e in ENTRIES)


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


@pytest.mark.parametrize("name", ["ok_sign_left_10", "back_flat_right_04"])
def test_holes_lie_inside_the_outline_and_are_uncovered(name, masks):
    (entry,) = (e for e in ENTRIES if Path(e["file"]).stem == name)
    (outer,), (hole,) = (
        [_filled(points, masks[name].shape) for points in polygons_of(entry, kind)]
        for kind in ("outer", "hole")
    )
    assert hole.sum() > 100 and outer[hole].all()
    assert masks[name][hole].mean() < 0.1  # only the pixels its edge runs through are covered in part


@every_photo
def test_the_hand_covers_a_plausible_share_of_its_photo_and_most_of_what_was_drawn(entry, masks, hands):
    name = Path(entry["file"]).stem
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
