import json
import os

import numpy as np
import pytest
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandFit, Landmarks
from oasis_warp.estimation.keypoints import read_keypoints

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
    assert any("outline badly" in warning for warning in read.warnings)


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
