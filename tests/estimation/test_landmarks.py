"""The 21 landmarks: found by the network, or read from a file."""

import json
import os

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandFit, Landmarks
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation import networks as module
from oasis_warp.estimation.keypoints import read_keypoints
from oasis_warp.estimation.landmarks import (
    FINGERS,
    DetectedHand,
    _undo_rotation,
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
    back = _undo_rotation(seen, turns, marked.shape, margin=1)
    np.testing.assert_allclose(back.xy[0], [6.5 - 1, 1.5 - 1])
    np.testing.assert_allclose(back.world[0], [0, 1, 2])


def test_landmarks_turn_with_the_photo(photos):
    picture = pixels(photos, "victory_right_09.jpg")
    (upright,) = detect_hands(picture, networks())
    (rotated,) = detect_hands(np.ascontiguousarray(np.rot90(picture)), networks())
    back = np.stack([picture.shape[1] - rotated.xy[:, 1], rotated.xy[:, 0]], 1)
    assert np.linalg.norm(back - upright.xy, axis=1).mean() < 0.02 * box_size(upright.xy)
    # World points turn along: x to the right and y down in each photo.
    world = np.stack([-rotated.world[:, 1], rotated.world[:, 0], rotated.world[:, 2]], 1)
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


NAME = "ok_sign_left_10.jpg"


def landmark_data(landmarks):
    return {"side": landmarks.side, "xy": landmarks.xy.tolist(), "world": landmarks.world.tolist()}


def pose_data(fit):
    return {
        "side": fit.side,
        "angles": fit.pose.angles.tolist(),
        "orientation": fit.pose.orientation.tolist(),
        "translation": fit.pose.translation.tolist(),
        "shape": fit.shape.tolist(),
        "focal": float(fit.camera.K[0, 0]),
    }


def write(path, data):
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def test_landmarks_come_back(fitted, tmp_path):
    photo, landmarks, _ = fitted(NAME)
    read = read_keypoints(write(tmp_path / "k.json", landmark_data(landmarks)), photo)
    assert isinstance(read, Landmarks)
    torch.testing.assert_close(read.xy, landmarks.xy)
    torch.testing.assert_close(read.world, landmarks.world)
    assert (read.side, read.source) == ("left", "file")


def test_pixels_of_the_file_are_scaled_to_a_photo_that_was_shrunk(fitted, tmp_path):
    photo, landmarks, _ = fitted(NAME)
    path = write(tmp_path / "k.json", {"side": "left", "xy": (4 * landmarks.xy).tolist()})
    read = read_keypoints(path, photo._replace(shrink=0.25))
    torch.testing.assert_close(read.xy, landmarks.xy)
    assert read.world is None


def test_landmarks_in_the_plane_alone_are_fitted(estimator, fitted, tmp_path):
    photo, landmarks, with_world = fitted(NAME)
    path = write(tmp_path / "k.json", {"side": "left", "xy": landmarks.xy.tolist()})
    fit = estimator.fit(photo, read_keypoints(path, photo))
    assert fit.reprojection < 3
    assert fit.mask_iou > 0.9
    # The same side of the hand faces the camera.
    assert (fit.pose.orientation[:, 1] * with_world.pose.orientation[:, 1]).sum() > 0.7


def test_a_pose_comes_back_as_a_fit_with_its_mask(hand, fitted, tmp_path):
    photo, _, fit = fitted(NAME)
    read = read_keypoints(write(tmp_path / "k.json", pose_data(fit)), photo)
    assert isinstance(read, HandFit)
    torch.testing.assert_close(read.pose.angles, fit.pose.angles)
    torch.testing.assert_close(read.pose.translation, fit.pose.translation)
    torch.testing.assert_close(read.camera.K, fit.camera.K)
    assert read.reprojection == pytest.approx(0, abs=0.01), "the landmarks are the model's own"
    assert read.mask_iou == pytest.approx(fit.mask_iou, abs=0.02)
    gap = (read.landmarks.xy - fit.landmarks.xy).norm(dim=1).mean() / np.ptp(fit.landmarks.xy.numpy(), 0).max()
    assert 100 * gap == pytest.approx(fit.reprojection, abs=0.05), "they lie where the fit's do"


def test_a_pose_elsewhere_is_warned_about(fitted, tmp_path):
    photo, _, fit = fitted(NAME)
    data = pose_data(fit)
    data["translation"][0] += 0.04
    read = read_keypoints(write(tmp_path / "k.json", data), photo)
    assert any("does not match the hand's outline" in warning for warning in read.warnings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"side": "both"}, r'"side" must be "left" or "right", got "both"'),
        ({"xy": [[1, 2]] * 20}, r'"xy" must be 21 x 2 numbers'),
        ({"xy": [[1, 2]] * 20 + [[1, "a"]]}, r'"xy" must be 21 x 2 numbers'),
        ({"xy": [[1, 2]] * 20 + [[1]]}, r'"xy" must be 21 x 2 numbers'),
        ({"xy": [[1, 2]] * 20 + [[1, float("nan")]]}, "NaN is no number"),
        ({"xy": [[-5, -5]] * 21}, r'"xy": none of the points lies in'),
        ({"xy": [[60, 60]] * 20 + [[1e6, 10]]}, r'"xy": a point lies far beyond the border'),
        ({"xy": [[60, 60]] * 20 + [[1e39, 10]]}, r'"xy" must be 21 x 2 numbers from -1e\+09'),
        ({"xy": [[60, 60]] * 21}, r'"xy": all points lie within 8 pixels'),
        ({"xy": [[10**400, 0]] * 21}, r'"xy" must be 21 x 2 numbers'),
        ({"xy": [[True, False]] * 21}, r'"xy" must be 21 x 2 numbers'),
        ({"world": [[0, 0, 1e6]] * 21}, r'"world" must be 21 x 3 numbers from -1 to 1'),
        ({"world": [[0.1, 0, 0.2]] * 21}, r'"world": all points lie within 10 mm'),
        ({"side": "\x1b[31m" * 10_000}, r'"side" must be "left" or "right"'),
        ({"k" * 10_000: 1}, "is not known here"),
        ({"world": [[0, 0]] * 21}, r'"world" must be 21 x 3 numbers'),
        ({"angles": [[0, 0, 0]] * 15}, r'either "xy" .* or "angles"'),
        ({"depth": 3}, r'the key "depth" is not known'),
    ],
)
def test_wrong_landmarks_get_one_sentence_that_names_the_key(fitted, tmp_path, change, words):
    photo, landmarks, _ = fitted(NAME)
    path = write(tmp_path / "k.json", landmark_data(landmarks) | change)
    with pytest.raises(InputError, match=words) as caught:
        read_keypoints(path, photo)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"focal": None}, r'"focal" must be a number'),
        ({"focal": -1}, r'"focal" must be a positive number'),
        ({"orientation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "must be a rotation matrix"),
        ({"translation": [0, 0, -0.5]}, "behind the camera"),
        ({"translation": [0, 0, 0.03]}, "puts fingers behind the camera"),
        ({"translation": [0, 0, 1e6]}, r'"translation" must be 3 numbers from -100 to 100'),
        ({"translation": [-1e6, 0, 0.5]}, r'"translation" must be 3 numbers from -100 to 100'),
        ({"translation": [-50, 0, 0.5]}, "none of the points lies in"),
        ({"translation": [0, 0, 99]}, "all points lie within 8 pixels"),
        ({"focal": 1e-300}, r'"focal" must be a positive number of pixels, [0-9]+ to [0-9]+ for this'),
        ({"focal": 1e9}, r'"focal" must be a positive number'),
        ({"centre": [1e9, 0]}, r'"centre" must be 2 numbers from'),
        ({"angles": [[1e3] * 3] * 15}, r'"angles" must be 15 x 3 numbers from'),
        ({"shape": [1e5] * 40}, r'"shape" must be 40 numbers from -10 to 10'),
        ({"shape": [0, 0]}, r'"shape" must be 40 numbers'),
        ({"angles": [0] * 45}, r'"angles" must be 15 x 3 numbers'),
        ({"centre": "middle"}, r'"centre" must be 2 numbers'),
    ],
)
def test_a_wrong_pose_gets_one_sentence_that_names_the_key(fitted, tmp_path, change, words):
    photo, _, fit = fitted(NAME)
    with pytest.raises(InputError, match=words):
        read_keypoints(write(tmp_path / "k.json", pose_data(fit) | change), photo)


@pytest.mark.parametrize("missing", ["angles", "orientation", "translation", "focal"])
def test_a_pose_that_lacks_something_says_what(fitted, tmp_path, missing):
    photo, _, fit = fitted(NAME)
    data = pose_data(fit)
    del data[missing]
    with pytest.raises(InputError, match=missing):
        read_keypoints(write(tmp_path / "k.json", data), photo)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "3", "\x00\x01", "[" * 100_000])
def test_what_is_no_object_of_json_is_refused(fitted, tmp_path, text):
    photo, _, _ = fitted(NAME)
    with pytest.raises(InputError, match="expected"):
        read_keypoints(write(tmp_path / "k.json", text), photo)


def test_a_missing_file_is_named(fitted, tmp_path):
    photo, _, _ = fitted(NAME)
    with pytest.raises(InputError, match=r"gone\.json: expected a JSON file of one hand, found no such file"):
        read_keypoints(tmp_path / "gone.json", photo)


@pytest.mark.timeout(10)
def test_a_pipe_and_an_endless_file_are_not_read(fitted, tmp_path):
    photo, _, _ = fitted(NAME)
    os.mkfifo(tmp_path / "pipe.json")
    for path in (tmp_path / "pipe.json", "/dev/zero"):
        with pytest.raises(InputError, match="found a device or pipe"):
            read_keypoints(path, photo)
    with (tmp_path / "big.json").open("w") as file:
        file.truncate(1 << 40)  # a hole
    with pytest.raises(InputError, match="more than 1 MB"):
        read_keypoints(tmp_path / "big.json", photo)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_camera_of_a_pose_is_scaled_to_a_photo_that_was_shrunk(fitted, tmp_path, side):
    photo, _, fit = fitted(NAME)
    K = fit.camera.K
    data = pose_data(fit) | {"side": side, "focal": 4 * float(K[0, 0]), "centre": (4 * K[:2, 2] + 12).tolist()}
    read = read_keypoints(write(tmp_path / "k.json", data), photo._replace(shrink=0.25))
    assert isinstance(read, HandFit)
    torch.testing.assert_close(read.camera.K[:2, 2], K[:2, 2] + 3)
    torch.testing.assert_close(read.camera.K[0, 0], K[0, 0])
