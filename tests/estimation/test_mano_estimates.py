"""Files of WiLoR and HaMeR, written here as their demos have them: the right hand's pose, and a flag for a left one."""

import json
import pickle
import zipfile

import numpy as np
import pytest
import torch

from oasis_warp.core import pickle_reader
from oasis_warp.core.errors import InputError
from oasis_warp.core.mirror import mirror_hand
from oasis_warp.core.types import HandFit, Landmarks, Photo
from oasis_warp.estimation.keypoints import read_keypoints
from oasis_warp.estimation.mano_estimates import full_camera, pose_of, read_estimate
from oasis_warp.hand.mano import ManoPose, mano_surface, read_mano, rotation_vectors, rotations
from oasis_warp.hand.skinning import rest_hand, skin

WIDTH, HEIGHT = 320, 240
PALM_UP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


@pytest.fixture
def photo():
    grey = np.random.default_rng(0).integers(90, 110, (HEIGHT, WIDTH, 3), np.uint8)
    return Photo(torch.from_numpy(grey), None, None, "photo.png", 1.0)


def hand(seed=0):
    """A right hand at the origin, fingers up."""
    random = np.random.default_rng(seed)
    turn = PALM_UP @ rotations(0.2 * random.normal(size=(1, 3)))[0]
    angles = 0.2 * random.normal(size=(15, 3))
    return ManoPose(random.normal(size=10), rotation_vectors(turn[None])[0], angles, np.zeros(3))


def demo_output(mano_dir, sides, *, matrices=True, camera="full", seed=0):
    """What the demos of both hold after a photo with hands of `sides`."""
    model, n = read_mano(mano_dir), len(sides)
    poses = [hand(seed + k) for k in range(n)]
    focal = 5000 / 256 * max(WIDTH, HEIGHT)
    vertices, joints = zip(*(mano_surface(model, pose) for pose in poses), strict=True)
    tips = [points[[744, 320, 443, 554, 671]] for points in vertices]
    order = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
    turns = [rotations(np.concatenate([p.global_orient[None], p.hand_pose])) for p in poses]
    weak = np.array([[9.0, 0.02 + 0.01 * k, -0.03] for k in range(n)])
    box_center, box_size = np.array([[150.0 + 10 * k, 130.0] for k in range(n)]), np.full(n, 90.0)
    flipped = weak * np.array([[1, 1 if side == "right" else -1, 1] for side in sides])
    places = np.stack([full_camera(flipped[k], box_center[k], box_size[k], (WIDTH, HEIGHT), focal) for k in range(n)])
    out = {
        "right": np.array([side == "right" for side in sides], np.float32),
        "pred_keypoints_3d": np.stack([np.concatenate(p)[order] for p in zip(joints, tips, strict=True)]),
        "pred_mano_params": {
            "global_orient": np.stack([t[:1] for t in turns]), "hand_pose": np.stack([t[1:] for t in turns]),
            "betas": np.stack([p.betas for p in poses]),
        },
    }  # fmt: skip
    if not matrices:
        out["pred_mano_params"] |= {"global_orient": np.stack([p.global_orient[None] for p in poses]),
                                    "hand_pose": np.stack([p.hand_pose for p in poses])}  # fmt: skip
    if camera == "full":
        out |= {"pred_cam_t_full": places, "scaled_focal_length": np.float32(focal)}
    else:
        out |= {"pred_cam": weak, "box_center": box_center, "box_size": box_size}
    return out, places, focal


def write(path, out):
    flat = {k: v for k, v in out.items() if k != "pred_mano_params"} | out.get("pred_mano_params", {})
    if path.suffix == ".npz":
        np.savez(path, **flat)
    elif path.suffix == ".json":
        path.write_text(json.dumps({name: np.asarray(value).tolist() for name, value in flat.items()}))
    else:
        path.write_bytes(pickle.dumps(out))
    return path


def test_the_middle_of_the_crops_camera_is_drawn_where_the_crop_has_it():
    weak, center, size, focal = np.array([0.8, 0.05, -0.1]), np.array([410.0, 95.0]), 130.0, 1234.0
    x, y, z = full_camera(weak, center, size, (640, 480), focal)
    drawn = focal * np.array([x, y]) / z + [320, 240]
    assert np.abs(drawn - (center + 0.8 * np.array([0.05, -0.1]) * size / 2)).max() < 1e-3


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("matrices", [True, False])
@pytest.mark.parametrize("camera", ["full", "weak"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_joints_are_drawn_where_the_demos_draw_them(mano, mano_dir, photo, tmp_path, suffix, matrices, camera, side):
    out, places, focal = demo_output(mano_dir, ["right", "left"], matrices=matrices, camera=camera)
    path = write(tmp_path / f"hands{suffix}", out)
    shape, pose, K = pose_of(path, read_estimate(path, photo, side), mano, photo)
    exact = (mirror_hand(mano) if side == "left" else mano).to(dtype=torch.float64)
    found = skin(exact, rest_hand(exact, torch.from_numpy(shape)), type(pose)(*(p.double() for p in pose))).joints
    k = int(side == "left")
    joints = mano_surface(read_mano(mano_dir), hand(k))[1] * [1 if side == "right" else -1, 1, 1] + places[k]
    want = focal * joints[:, :2] / joints[:, 2:] + [WIDTH / 2, HEIGHT / 2]
    drawn = (found / found[:, 2:] @ K.K.double().T)[:, :2].numpy()
    assert np.abs(drawn - want).max() < 1e-3


def test_without_mano_the_points_are_landmarks_of_the_bundled_hand(mano_dir, photo, tmp_path):
    out, places, focal = demo_output(mano_dir, ["left"])
    small = photo._replace(rgb=photo.rgb[::2, ::2], shrink=0.5)
    read = read_keypoints(write(tmp_path / "hands.npz", out), small)
    assert isinstance(read, Landmarks) and read.side == "left"
    points = out["pred_keypoints_3d"][0] * [-1, 1, 1] + places[0]
    want = 0.5 * (focal * points[:, :2] / points[:, 2:] + [WIDTH / 2, HEIGHT / 2])
    assert np.abs(read.xy.numpy() - want).max() < 1e-3
    del out["pred_keypoints_3d"]
    with pytest.raises(InputError, match="has no 21 points .* give --hand-model mano"):
        read_keypoints(write(tmp_path / "hands.npz", out), photo)


def test_any_estimators_parameters_pass_as_json_and_all_45_angles_count(mano, mano_dir, photo, tmp_path):
    out, _, _ = demo_output(mano_dir, ["left"], matrices=False)
    fit = read_keypoints(write(tmp_path / "hand.json", out), photo, hand=mano)
    assert isinstance(fit, HandFit) and fit.reprojection < 1e-3 and fit.side == "left"
    assert np.abs(fit.shape.numpy() - hand().betas).max() < 1e-6


def test_one_of_several_hands_is_chosen_as_in_photos(mano_dir, photo, tmp_path):
    out, places, _ = demo_output(mano_dir, ["left", "right", "left"])
    out["pred_cam_t_full"][2, 2] *= 0.5  # the nearest
    path = write(tmp_path / "hands.npz", out)
    for which, k in (("left", 0), ("right", 1), (2, 2), ("largest", 2)):
        found = read_estimate(path, photo, which)
        assert np.allclose(found.place[:2], places[k][:2])
    with pytest.raises(InputError, match="expected hand 3, found 0: left, 1: right, 2: left"):
        read_estimate(path, photo, 3)
    listed = [{"is_right": 1.0, "wilor_preds": {"pred_cam_t_full": places[:1], "scaled_focal_length": 5000.0}}]
    (tmp_path / "list.pkl").write_bytes(pickle.dumps(listed))
    assert np.allclose(read_estimate(tmp_path / "list.pkl", photo).place, places[0])


def _set(name, value):
    def change(out):
        table = out["pred_mano_params"] if name in out["pred_mano_params"] else out
        table[name] = value(table[name]) if callable(value) else value

    return change


def _drop(*names):
    return lambda out: [out.pop(name) for name in names]


DAMAGE = {
    "no side": (_drop("right"), '"right" .* is missing'),
    "no camera": (_drop("pred_cam_t_full"), "the camera is missing"),
    "no pose": (_drop("pred_mano_params"), '"global_orient", "hand_pose" and "betas" are missing'),
    **{f"{name} not finite": (_set(name, lambda v: v * np.nan), f'"{name}" must be finite numbers')
       for name in ("global_orient", "hand_pose", "betas", "pred_cam_t_full", "right", "pred_keypoints_3d")},
    **{f"{name} huge": (_set(name, lambda v: v + 1e12), f'"{name}" must be finite numbers of common size')
       for name in ("betas", "pred_cam_t_full", "scaled_focal_length")},
    **{f"{name} cut": (_set(name, lambda v: v[..., :-1]), f'"{name}" must be .* numbers a hand')
       for name in ("global_orient", "hand_pose", "betas", "pred_cam_t_full", "pred_keypoints_3d")},
    **{f"{name} texts": (_set(name, np.array(["a"])), f'("{name}" must be finite|are no) numbers')
       for name in ("right", "betas", "scaled_focal_length")},
    "a reflection": (_set("global_orient", lambda v: -v), "are no rotation"),
    "a stretch": (_set("hand_pose", lambda v: 2 * v), "are no rotation"),
    "behind": (_set("pred_cam_t_full", lambda v: -v), "puts the hand .* m away"),
    "in the camera": (_set("pred_cam_t_full", lambda v: 0 * v), "puts the hand 0 m away"),
    "short focal": (_set("scaled_focal_length", 1.0), "a focal length of 1 pixels"),
    "long focal": (_set("scaled_focal_length", 9e5), "a focal length of 900000 pixels"),
    "aside": (_set("pred_cam_t_full", lambda v: v + np.array([50.0, 0, 0])), "none of the points lies in photo.png"),
    "many": (_set("right", np.ones(2000)), "2000 hands are more than 1000"),
}  # fmt: skip
WHOLE = {
    "empty": b"",
    "a picture": b"\x89PNG\r\n\x1a\n" + bytes(99),
    "cut zip": None,
    "an object": b"PK\x03\x04" + bytes(64),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_refused_in_a_sentence(kind, mano, mano_dir, photo, tmp_path):
    change, message = DAMAGE[kind]
    out, _, _ = demo_output(mano_dir, ["right"])
    change(out)
    for suffix in (".npz", ".pkl"):
        with pytest.raises(InputError, match=message) as raised:
            read_keypoints(write(tmp_path / f"hands{suffix}", out), photo, hand=mano)
        assert f"hands{suffix}: " in str(raised.value)


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("kind", WHOLE)
def test_a_file_that_is_none_is_refused(kind, suffix, mano_dir, photo, tmp_path):
    path = tmp_path / f"hands{suffix}"
    content = WHOLE[kind]
    if content is None:
        content = write(tmp_path / "good.npz", demo_output(mano_dir, ["right"])[0]).read_bytes()[:-300]
    path.write_bytes(content)
    with pytest.raises(InputError, match="expected (an estimator's hands|arrays of numbers)"):
        read_keypoints(path, photo)


def test_an_archive_that_unpacks_without_end_is_refused_before_it_does(photo, tmp_path, monkeypatch):
    monkeypatch.setattr(pickle_reader, "MAX_BYTES", 1 << 20)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("right.npy", bytes(3 << 20))
    with pytest.raises(InputError, match="unpacks to more than 1 MB"):
        read_keypoints(tmp_path / "bomb.npz", photo)
