"""Hands that WiLoR, HaMeR and other estimators of MANO found: their files as landmarks or fits (docs/mano.md).

All of them estimate a right hand; the crop of a left one is mirrored before. With the hand model MANO their shape, pose
and camera are taken as they are. With the bundled hand their 21 points are, and it is fitted to these.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.hand_model import MANO_SHAPES, HandModel
from oasis_warp.core.mirror import mirror_pose
from oasis_warp.core.pickle_reader import read_npz, read_pickle
from oasis_warp.core.types import Camera, HandPose, Landmarks, Photo, Side
from oasis_warp.hand.mano import ManoPose, rotation_vectors
from oasis_warp.hand.mano_hand import hand_pose_of_mano

SUFFIXES = (".npz", ".pkl", ".pickle")
NETWORK_FOCAL = 5000.0 / 256
"""Focal length that both estimators assume, over the longer side of the photo, where the file has none."""
MAX_HANDS, MAX_NUMBER = 1000, 1e6
_NESTED = ("pred_mano_params", "mano_params", "wilor_preds", "params", "out")
"""Entries whose own entries count as those of the file."""
_NAMES = {
    "right": ("right", "is_right"),
    "orient": ("global_orient", "pred_global_orient"),
    "pose": ("hand_pose", "pred_hand_pose"),
    "betas": ("betas", "pred_betas"),
    "place": ("pred_cam_t_full", "cam_t_full", "cam_t", "transl"),
    "focal": ("scaled_focal_length", "focal_length", "focal"),
    "weak": ("pred_cam",),
    "box_center": ("box_center",),
    "box_size": ("box_size",),
    "centre": ("centre", "principal_point"),
    "points": ("pred_keypoints_3d", "keypoints_3d", "joints"),
}
_SIZES = {"right": 1, "betas": MANO_SHAPES, "place": 3, "focal": 1, "weak": 3, "box_center": 2, "box_size": 1,
          "centre": 2, "points": 63}  # fmt: skip
Which = Literal["left", "right", "largest"] | int


class Estimate(NamedTuple):
    """One hand; pose and points are those of a right hand, before a left one is mirrored back."""

    side: Side
    pose: ManoPose | None
    """At the origin: `transl` is 0."""
    points: np.ndarray | None
    """21 landmarks [m], [21, 3]."""
    place: np.ndarray
    """What is added to the hand in the camera's frame [m], [3]."""
    focal: float
    """Focal length of the file's photo [px]."""
    centre: np.ndarray
    """[px], [2]."""


def full_camera(
    weak: np.ndarray, box_center: np.ndarray, box_size: float, size: tuple[int, int], focal: float
) -> np.ndarray:
    """Place of a hand in the whole photo's camera [m], [3], from the weak perspective (s, x, y) of its crop.

    As `cam_crop_to_full` of HaMeR and WiLoR: depth 2 f / (s b), and x and y moved by the crop's own place.

    Args:
        weak: Scale and shift of the network; of a left hand with x mirrored back.
        box_center: Centre of the crop [px], [2].
        box_size: Side of the crop [px].
        size: Width and height of the photo.
        focal: [px].
    """
    scale = box_size * weak[0] + 1e-9
    shift = 2 * (np.asarray(box_center) - np.array(size) / 2) / scale
    return np.array([shift[0] + weak[1], shift[1] + weak[2], 2 * focal / scale])


def read_estimate(
    path: Path, photo: Photo, which: Which = "largest", content: bytes | None = None
) -> Estimate:
    """One hand of an .npz or pickle file of an estimator.

    Args:
        path: The file.
        photo: What it was estimated from.
        which: The hand to take where there are several.
        content: Its bytes, where they lie elsewhere; `path` is for messages then.

    Raises:
        InputError: not such a file, no such hand in it, or entries that are missing or wrong; the sentence names them.
    """
    tables = _records(path, _load(path, content))
    records = [estimate for table in tables for estimate in _estimates(path, table, photo)]
    if not records:
        raise InputError(f"{path}: no hand in it; give the estimator's output of a photo with a hand.")
    if which == "largest":
        return min(records, key=lambda found: found.place[2] / found.focal)
    if isinstance(which, int) and which < len(records):
        return records[which]
    for found in records:
        if found.side == which:
            return found
    wanted = f"hand {which}" if isinstance(which, int) else f"a {which} hand"
    listed = ", ".join(f"{k}: {found.side}" for k, found in enumerate(records))
    raise InputError(f"{path}: expected {wanted}, found {shortened(listed)}; choose one of these with --hand.")


def estimate_of_entries(path: Path, entries: Mapping[str, Any], photo: Photo) -> Estimate:
    """The hand of a table with `read_estimate`'s names that comes from elsewhere, such as JSON."""
    return _estimates(path, _flat(entries), photo)[0]


def landmarks_of(path: Path, found: Estimate, photo: Photo) -> Landmarks:
    """The estimate's 21 points in the photo.

    Raises:
        InputError: it has none.
    """
    if found.points is None:
        raise InputError(
            f'{path}: has no 21 points ("pred_keypoints_3d") for the bundled hand; give --hand-model mano with '
            "MANO's files, or save the points too."
        )
    mirror = [-1.0, 1.0, 1.0] if found.side == "left" else [1.0, 1.0, 1.0]
    points = found.points * mirror + found.place
    if points[:, 2].min() <= 0:
        raise InputError(f"{path}: its camera puts points behind it; give the whole photo's translation, in metres.")
    xy = (points[:, :2] / points[:, 2:] * found.focal + found.centre) * photo.shrink
    world = points - points.mean(0)
    return Landmarks(torch.from_numpy(xy).float(), torch.from_numpy(world).float(), found.side, 1.0, 1.0, "file")


def pose_of(path: Path, found: Estimate, hand: HandModel, photo: Photo) -> tuple[np.ndarray, HandPose, Camera]:
    """Shape, pose and camera of the estimate for the hand model MANO, in the photo.

    Raises:
        InputError: it has points only.
    """
    if found.pose is None:
        raise InputError(f'{path}: the entries "global_orient", "hand_pose" and "betas" are missing; save them too.')
    pose = hand_pose_of_mano(hand, found.pose)
    pose = mirror_pose(pose) if found.side == "left" else pose
    pose = pose._replace(translation=pose.translation + torch.from_numpy(found.place))
    pose = HandPose(*(part.float() for part in pose))
    height, width = photo.rgb.shape[:2]
    focal, (x, y) = found.focal * photo.shrink, found.centre * photo.shrink
    K = torch.tensor([[focal, 0, x], [0, focal, y], [0, 0, 1]], dtype=torch.float32)
    return found.pose.betas, pose, Camera(torch.eye(4), K, width, height)


# ---- files


def _load(path: Path, content: bytes | None) -> Any:
    if path.suffix != ".npz":
        return read_pickle(path, "an estimator's hands", content)
    return read_npz(path, content=content)


def _flat(entries: Mapping[str, Any]) -> dict[str, Any]:
    found = {name: value for name, value in entries.items() if name not in _NESTED}
    for name in _NESTED:
        if isinstance(entries.get(name), Mapping):
            found = _flat(entries[name]) | found
    return found


def _records(path: Path, content: Any) -> list[dict[str, Any]]:
    """Tables of one or more hands each."""
    items = content if isinstance(content, list | tuple) else [content]
    if len(items) > MAX_HANDS or not all(isinstance(item, Mapping) for item in items):
        raise InputError(f"{path}: expected a table of arrays, or a list of them, a hand each; save it that way.")
    return [_flat(item) for item in items]


def _estimates(path: Path, record: Mapping[str, Any], photo: Photo) -> list[Estimate]:
    """The hands of one table."""
    arrays = {}
    for name, given in _NAMES.items():
        key = next((key for key in given if record.get(key) is not None), None)
        if key is not None:
            arrays[name] = key, _array(path, key, record[key])
    if "right" not in arrays:
        raise InputError(f'{path}: the entry "right" (1, or 0 for a left hand) is missing; save it too.')
    n_hands = arrays["right"][1].size
    if n_hands > MAX_HANDS:
        raise InputError(f"{path}: {n_hands} hands are more than {MAX_HANDS}; give the output of one photo.")
    hands = []
    for k in range(n_hands):
        hand = {name: _row(path, key, values, k, n_hands, name) for name, (key, values) in arrays.items()}
        hands.append(_estimate(path, hand, photo))
    return hands


def _array(path: Path, key: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    good = array.dtype.kind in "iufb" and bool(np.isfinite(array).all())
    if not good or np.abs(array.astype(np.float64)).max(initial=0) > MAX_NUMBER:
        raise InputError(f'{path}: "{key}" must be finite numbers of common size; save it again.')
    return array.astype(np.float64)


def _row(path: Path, key: str, values: np.ndarray, k: int, n_hands: int, name: str) -> np.ndarray:
    """The numbers of one of `n_hands` hands."""
    if name in ("orient", "pose"):
        joints = 1 if name == "orient" else 15
        sizes = [each * joints for each in (3, 9)]
    else:
        sizes = [_SIZES[name]]
    if values.size in [n_hands * size for size in sizes]:
        return values.reshape(n_hands, -1)[k]
    if values.size in sizes:  # one for all, as a focal length
        return values.ravel()
    listed = " or ".join(map(str, sizes))
    raise InputError(
        f'{path}: "{key}" must be {listed} numbers a hand, got {values.size} for {n_hands} hands; save it again.'
    )


def _estimate(path: Path, hand: dict[str, np.ndarray], photo: Photo) -> Estimate:
    height, width = photo.rgb.shape[:2]
    size = round(width / photo.shrink), round(height / photo.shrink)
    focal = float(hand["focal"][0]) if "focal" in hand else NETWORK_FOCAL * max(size)
    if not 0.05 * max(size) <= focal <= 1000 * max(size):
        raise InputError(f"{path}: a focal length of {focal:.6g} pixels does not belong to {photo.name}; correct it.")
    side: Side = "right" if hand["right"][0] > 0.5 else "left"
    if "place" in hand:
        place = hand["place"]
    elif all(name in hand for name in ("weak", "box_center", "box_size")):
        weak = hand["weak"] * [1, 1 if side == "right" else -1, 1]
        if weak[0] * hand["box_size"][0] <= 0:
            raise InputError(f'{path}: "pred_cam" and "box_size" must give a positive scale; save them again.')
        place = full_camera(weak, hand["box_center"], float(hand["box_size"][0]), size, focal)
    else:
        raise InputError(
            f'{path}: the camera is missing: "pred_cam_t_full", or "pred_cam", "box_center", "box_size"; save it too.'
        )
    if not 0.02 < place[2] < 1000:
        raise InputError(f"{path}: its camera puts the hand {place[2]:.3g} m away; save it in metres, z forward.")
    pose = None
    if all(name in hand for name in ("orient", "pose", "betas")):
        vectors = [_vectors(path, hand[name]) for name in ("orient", "pose")]
        pose = ManoPose(hand["betas"], vectors[0][0], vectors[1], np.zeros(3))
    centre = hand.get("centre", np.array(size) / 2)
    points = hand["points"].reshape(21, 3) if "points" in hand else None
    return Estimate(side, pose, points, place, focal, centre)


def _vectors(path: Path, values: np.ndarray) -> np.ndarray:
    """Axis times angle, [N, 3], of these or of rotation matrices."""
    if values.size in (3, 45):
        return values.reshape(-1, 3)
    matrices = values.reshape(-1, 3, 3)
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max()
    if off > 1e-2 or (np.linalg.det(matrices) < 0).any():
        raise InputError(
            f"{path}: a joint's 3 x 3 numbers are no rotation; save rotation matrices, or axis times angle."
        )
    return rotation_vectors(matrices)
