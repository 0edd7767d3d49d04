"""Read landmarks, or a pose and camera, from another tool's JSON file: one object per hand (docs/estimator.md)."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_landmarks
from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo, Side
from oasis_warp.estimation.fit_problem import MirroredInput, mirrored_state, real
from oasis_warp.estimation.fit_quality import fit_quality, framing_warnings
from oasis_warp.estimation.pixel_reading import read_pixels
from oasis_warp.estimation.segmentation import mask_from_alpha, mask_from_reading
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.template import bundled_hand

_LANDMARK_KEYS = {"side", "xy", "world"}
_POSE_KEYS = {"side", "angles", "orientation", "translation", "shape", "focal", "centre"}
_MAX_BYTES = 1 << 20


def read_keypoints(path: Path | str, photo: Photo, *, hand: HandModel | None = None) -> Landmarks | HandFit:
    """Landmarks from `{"side", "xy", "world"?}`, a fit from `{"side", "angles", ...}`.

    Pixels are those of the photo's file, upright; they are scaled to `photo` where that was shrunk. `hand` is the model
    that a pose belongs to, the bundled one by default.

    Raises:
        InputError: no such file, no JSON, or values that cannot be a hand; the sentence names the key.
    """
    path = Path(path)
    data = _read_object(path)
    side = data.get("side")
    if side not in ("left", "right"):
        raise InputError(f'{path}: "side" must be "left" or "right", got {json.dumps(side)}; add it.')
    if ("xy" in data) == ("angles" in data):
        raise InputError(f'{path}: expected either "xy" (21 landmarks) or "angles" (a pose); see docs/estimator.md.')
    if unknown := sorted(set(data) - (_LANDMARK_KEYS if "xy" in data else _POSE_KEYS)):
        raise InputError(f'{path}: the key "{unknown[0]}" is not known here; see docs/estimator.md for those that are.')
    if "xy" in data:
        return _landmarks(path, data, side, photo)
    return _pose(path, data, side, photo, hand or bundled_hand())


def _landmarks(path: Path, data: dict[str, Any], side: Side, photo: Photo) -> Landmarks:
    height, width = photo.rgb.shape[:2]
    xy = _numbers(path, data, "xy", (21, 2)) * photo.shrink
    if not ((xy >= 0) & (xy <= [width, height])).all(1).any():
        raise InputError(f'{path}: none of the points of "xy" lies in {photo.name}; give pixels of the upright photo.')
    world = _numbers(path, data, "world", (21, 3)) if "world" in data else None
    return Landmarks(real(xy), None if world is None else real(world), side, 1.0, 1.0, "file")


def _pose(path: Path, data: dict[str, Any], side: Side, photo: Photo, hand: HandModel) -> HandFit:
    height, width = photo.rgb.shape[:2]
    rotation = _numbers(path, data, "orientation", (3, 3))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise InputError(f'{path}: "orientation" must be a rotation matrix (orthonormal, determinant 1); correct it.')
    translation = _numbers(path, data, "translation", (3,))
    if translation[2] <= 0.02:
        raise InputError(f'{path}: "translation" puts the hand behind the camera; z points forward, in metres.')
    focal = float(_numbers(path, data, "focal", ())) * photo.shrink
    if focal <= 0:
        raise InputError(f'{path}: "focal" must be a positive number of pixels, got {data["focal"]}; correct it.')
    size = hand.shape_basis.shape[2]
    shape = _numbers(path, data, "shape", (size,)) if "shape" in data else np.zeros(size)
    centre = np.array([width, height]) / 2
    if "centre" in data:
        centre = _numbers(path, data, "centre", (2,)) * photo.shrink
    pose = HandPose(real(_numbers(path, data, "angles", (15, 3))), real(rotation), real(translation))
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    return fit_of_pose(hand, photo, side, shape, pose, Camera(torch.eye(4), real(K), width, height))


def fit_of_pose(
    hand: HandModel, photo: Photo, side: Side, shape: np.ndarray, pose: HandPose, camera: Camera
) -> HandFit:
    """The fit of a given pose: only the mask is estimated from the photo.

    The landmarks are the model's own, so their error is zero.

    Args:
        hand: The model that `shape` and `pose` belong to.
        photo: The photo.
        side: Of the hand; a left hand's pose describes the mirrored model.
        shape: Coefficients, [S].
        pose: In the camera's frame.
        camera: Of the photo, with an identity viewmat.
    """
    kinematics = HandKinematics(hand)
    state = mirrored_state(kinematics, side, shape, pose, camera)
    points = kinematics.landmarks(kinematics.pose_joints(state.angles, state.shape))[0]
    xy, world = torch.from_numpy(state.project(points)), torch.from_numpy(state.in_camera(points))
    landmarks = Landmarks(xy.float(), (world - world.mean(0)).float(), "right", 1.0, 1.0, "file")
    if side == "left":
        landmarks = mirror_landmarks(landmarks, camera.width)
    view = MirroredInput(photo, landmarks, state.focal)
    state = replace(state, focal=state.focal * float(view.scale[0]), centre=state.centre * view.scale)
    scale, xy = state.pixels_per_metre(), view.target.xy
    reading = read_pixels(view.rgb, xy)
    mask = None if view.alpha is None else mask_from_alpha(view.alpha, reading, xy, scale)
    mask = mask_from_reading(view.rgb, reading, xy) if mask is None else mask
    quality = fit_quality(kinematics, view.target, state, mask, 0.0)
    return HandFit(
        side=side,
        shape=real(shape),
        pose=pose,
        camera=camera,
        landmarks=landmarks,
        mask=real(view.in_photo(mask)),
        **vars(quality),
        warnings=(*quality.warnings(), *framing_warnings(view.target, mask)),
    )


def _read_object(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"{path}: expected a JSON file of one hand, got more than 1 MB; give the right file.")
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the name and the permissions.") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON, got something else; see docs/estimator.md for the format.") from error
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object with the keys of one hand; see docs/estimator.md.")
    return data


def _numbers(path: Path, data: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
    expected = " x ".join(map(str, shape)) + " numbers" if shape else "a number"
    if key not in data:
        raise InputError(f'{path}: the key "{key}" is missing; add {expected}.')
    try:
        values = np.array(data[key])
    except ValueError:
        values = np.array(None)
    if values.dtype.kind not in "iuf" or values.shape != shape or not np.isfinite(values).all():
        raise InputError(f'{path}: "{key}" must be {expected}, all finite; correct it.')
    return values.astype(np.float64)
