import cv2
import numpy as np
import pytest

from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation import networks as module
from oasis_warp.estimation.landmarks import (
    FINGERS,
    DetectedHand,
    _turned_back,
    box_size,
    crop_of_landmarks,
    detect_hands,
    read_crop,
)
from oasis_warp.estimation.networks import Networks, check_networks, drawn_hand, networks

HANDS = {
    "palm_open_right_01.jpg": "right",
    "palm_open_left_02.png": "left",
    "back_flat_right_04.jpg": "right",
    "thumb_up_left_06.jpg": "left",
    "fist_front_right_08.jpg": "right",
}


def pixels(photos, name):
    return read_photo(photos / name).rgb.numpy()


@pytest.mark.parametrize("name", HANDS)
def test_a_hand_is_found_with_its_side(photos, estimator, name):
    found = estimator.find(read_photo(photos / name))
    assert [hand.side for hand in found] == [HANDS[name]]
    assert found[0].source == "network"
    assert found[0].presence > 0.9
    assert found[0].side_score > 0.9


@pytest.mark.parametrize(
    "picture",
    ["cup", "pixel", pytest.param("noise", marks=pytest.mark.slow), pytest.param("strip", marks=pytest.mark.slow)],
)
def test_no_hand_is_found_where_there_is_none(photos, picture):
    pictures = {
        "cup": pixels(photos, "no_hand_cup_15.jpg"),
        "noise": np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8),
        "pixel": np.zeros((1, 1, 3), np.uint8),
        "strip": np.full((3, 900, 3), 128, np.uint8),
    }
    assert detect_hands(pictures[picture], networks()) == []


def test_two_hands_are_told_apart(photos):
    found = detect_hands(pixels(photos, "backs_two_left_05.jpg"), networks())
    assert len(found) == 2
    assert abs(found[0].xy.mean(0)[0] - found[1].xy.mean(0)[0]) > 100


def test_a_hand_in_the_dark_is_found_by_a_fallback_rung_in_its_own_place(photos):
    picture = pixels(photos, "backlit_victory_14.jpg")
    (hand,) = detect_hands(picture, networks())
    assert hand.source == "network (margin, brightened)"
    assert (hand.xy > 0).all()
    assert (hand.xy < picture.shape[1::-1]).all()
    assert hand.xy[[8, 12], 1].max() < hand.xy[0, 1], "two fingers up"


@pytest.mark.parametrize("turns", range(4))
def test_points_of_a_turned_search_lie_where_they_are_in_the_photo(turns):
    marked = np.zeros((5, 8))
    marked[1, 6] = 1
    row, column = np.argwhere(np.rot90(marked, turns))[0]
    xy = np.tile([[column + 0.5, row + 0.5]], (21, 1))
    down = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), turns) @ [0, 1]  # "down" of the photo, turned
    seen = DetectedHand(xy, np.tile([[*down, 2.0]], (21, 1)), 1.0, 1.0, 1.0, "")
    back = _turned_back(seen, turns, marked.shape, margin=1)
    np.testing.assert_allclose(back.xy[0], [6.5 - 1, 1.5 - 1])
    np.testing.assert_allclose(back.world[0], [0, 1, 2])


def test_landmarks_turn_with_the_photo(photos):
    picture = pixels(photos, "victory_right_09.jpg")
    (upright,) = detect_hands(picture, networks())
    (turned,) = detect_hands(np.ascontiguousarray(np.rot90(picture)), networks())
    back = np.stack([picture.shape[1] - turned.xy[:, 1], turned.xy[:, 0]], 1)
    assert np.linalg.norm(back - upright.xy, axis=1).mean() < 0.02 * box_size(upright.xy)
    # World points turn along: x to the right and y down in each photo.
    world = np.stack([-turned.world[:, 1], turned.world[:, 0], turned.world[:, 2]], 1)
    assert np.linalg.norm(world - upright.world, axis=1).mean() < 0.01


@pytest.mark.parametrize("mirrored", [False, True])
def test_another_crop_of_the_same_hand_gives_the_same_landmarks(photos, mirrored):
    picture = pixels(photos, "palm_open_left_02.png")
    (hand,) = detect_hands(picture, networks())
    again = read_crop(picture, networks(), crop_of_landmarks(hand.xy), mirrored=mirrored)
    assert np.linalg.norm(again.xy - hand.xy, axis=1).max() < 0.05 * box_size(hand.xy)
    assert np.linalg.norm(again.world - hand.world, axis=1).mean() < 0.01
    assert again.right < 0.2, "a left hand, mirrored in the crop or not"


def test_a_photo_of_twice_the_size_gives_points_twice_as_far(photos):
    picture = pixels(photos, "victory_right_09.jpg")
    (small,) = detect_hands(picture, networks())
    (large,) = detect_hands(cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC), networks())
    assert np.linalg.norm(large.xy / 4 - small.xy, axis=1).mean() < 0.01 * box_size(small.xy)


def test_finding_is_repeatable(photos):
    picture = pixels(photos, "ok_sign_left_10.jpg")
    first, second = (detect_hands(picture, networks())[0] for _ in range(2))
    np.testing.assert_array_equal(first.xy, second.xy)
    np.testing.assert_array_equal(first.world, second.world)


def test_fingers_cover_all_points_but_the_wrist():
    assert sorted(row for rows in FINGERS.values() for row in rows) == list(range(1, 21))


# ---- the networks


def test_this_installation_computes_the_networks_rightly():
    check_networks()


def test_the_drawing_shows_an_open_right_hand():
    seen = networks().hand(drawn_hand(224))
    assert seen.presence > 0.7
    assert seen.right > 0.9
    assert seen.points[8, 1] < seen.points[5, 1] < seen.points[0, 1], "the index finger points up"


def test_an_old_opencv_is_refused_before_it_can_answer_wrongly(monkeypatch):
    monkeypatch.setattr(cv2, "__version__", "4.11.0")
    with pytest.raises(InputError, match=r"OpenCV 4\.11\.0: .*install opencv-contrib-python-headless 5"):
        networks.__wrapped__()


@pytest.mark.parametrize("fault", ["points", "world", "side"])
def test_a_version_that_computes_wrongly_is_refused(monkeypatch, fault):
    right = Networks.hand

    def wrong(self, image):
        seen = right(self, image)
        # As large as what OpenCV 4.11 gets wrong: 3 px and 0.27 m.
        changes = {"points": seen.points + 3.0, "world": seen.world + 0.27, "side": seen.right - 0.5}
        key = {"side": "right"}.get(fault, fault)
        return module.HandOutput(**{**vars(seen), key: changes[fault]})

    monkeypatch.setattr(Networks, "hand", wrong)
    with pytest.raises(InputError, match="computes the hand networks wrongly"):
        networks.__wrapped__()


def test_a_detector_that_computes_wrongly_is_refused(monkeypatch):
    right = Networks.palm
    monkeypatch.setattr(Networks, "palm", lambda self, image: right(self, np.zeros_like(image)))
    with pytest.raises(InputError, match="computes the hand networks wrongly"):
        networks.__wrapped__()


def test_outputs_that_cannot_be_read_are_refused(monkeypatch):
    monkeypatch.setattr(module, "_HAND_OUTPUTS", ("Identity", "Identity_1", "Identity_2", "no_such_output"))
    with pytest.raises(InputError, match="cannot run the hand networks"):
        networks.__wrapped__()


def test_a_damaged_network_file_is_refused(monkeypatch):
    files = dict.fromkeys(module._FILES, "0" * 64)
    monkeypatch.setattr(module, "_FILES", files)
    with pytest.raises(InputError, match=r"palm_detection_full\.tflite: the network file is damaged"):
        networks.__wrapped__()
