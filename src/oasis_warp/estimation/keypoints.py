"""Read landmarks, or a pose and camera, from another tool's JSON file: one object per hand (docs/estimator.md)."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_landmarks
from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo, Side
from oasis_warp.data.json_text import MAX_LETTERS, read_json
from oasis_warp.estimation.fit_problem import FitState, MirroredInput, mirrored_state, real
from oasis_warp.estimation.fit_quality import fit_quality, framing_warnings
from oasis_warp.estimation.mano_estimates import (
    SUFFIXES,
    Estimate,
    Which,
    estimate_of_entries,
    landmarks_of,
    pose_of,
    read_estimate,
)
from oasis_warp.estimation.pixel_reading import read_pixels, surface_reading
from oasis_warp.estimation.segmentation import mask_from_alpha, mask_from_reading
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.template import bundled_hand

_LANDMARK_KEYS = {"side", "xy", "world"}
_POSE_KEYS = {"side", "angles", "orientation", "translation", "shape", "focal", "centre"}
FAR_OUT = 1.0
"""Farthest landmark beyond the border of the photo, over its longer side: a hand may be cut, not far away."""
MIN_PIXELS = 8
"""Least extent of a hand [px of the photo as read]; nothing can be seen of a smaller one."""
MIN_WORLD = 0.01
"""Least extent of the points of `world` [m]: a fist has a few times as much."""
FOCALS = (0.05, 1000.0)
"""Least and greatest focal length over the photo's longer side: a fisheye, and a crop from far away."""
DEPTHS = (0.02, 100.0)
"""Nearest and farthest hand [m]."""
REACH, MAX_SHAPE, MAX_ANGLE = 1.0, 10.0, 2 * math.pi
"""Bounds of `world` [m], `shape` [standard deviations] and `angles` [rad]."""
MAX_NUMBER = 1e9
"""Bound of all other numbers: float32 holds their squares."""


def read_keypoints(
    path: Path | str, photo: Photo, *, hand: HandModel | None = None, which: Which = "largest"
) -> Landmarks | HandFit:
    """Landmarks from `{"side", "xy", "world"?}`, a fit from `{"side", "angles", ...}`, either from MANO's parameters.

    Pixels are those of the photo's file, upright; they are scaled to `photo` where that was shrunk. `hand` is the model
    that a pose belongs to, the bundled one by default. Files of estimators of MANO, .npz and .pkl, may have several
    hands, of which `which` is taken (`mano_estimates`).

    Raises:
        InputError: no such file, no JSON, or values that cannot be a hand; the sentence names the key.
    """
    path, hand = Path(path), hand or bundled_hand()
    if path.suffix in SUFFIXES:
        return _of_mano(path, read_estimate(path, photo, which), photo, hand)
    data = _read_object(path)
    if "global_orient" in data or "pred_keypoints_3d" in data:
        return _of_mano(path, estimate_of_entries(path, data, photo), photo, hand)
    side = data.get("side")
    if side not in ("left", "right"):
        raise InputError(f'{path}: "side" must be "left" or "right", got {shortened(json.dumps(side))}; add it.')
    if ("xy" in data) == ("angles" in data):
        raise InputError(f'{path}: expected either "xy" (21 landmarks) or "angles" (a pose); see docs/estimator.md.')
    if unknown := sorted(set(data) - (_LANDMARK_KEYS if "xy" in data else _POSE_KEYS)):
        key = shortened(unknown[0])
        raise InputError(f'{path}: the key "{key}" is not known here; see docs/estimator.md for those that are.')
    if "xy" in data:
        return _landmarks(path, data, side, photo)
    return _pose(path, data, side, photo, hand)


def _of_mano(path: Path, found: Estimate, photo: Photo, hand: HandModel) -> Landmarks | HandFit:
    """The estimate's pose for MANO, its points for any other hand."""
    if hand.name == "mano":
        shape, pose, camera = pose_of(path, found, hand, photo)
        return _checked_fit(path, hand, photo, found.side, shape, pose, camera)
    landmarks = landmarks_of(path, found, photo)
    _check_points(f"{path}: its points and camera", landmarks.xy.double().numpy(), photo)
    return landmarks


def _landmarks(path: Path, data: dict[str, Any], side: Side, photo: Photo) -> Landmarks:
    xy = _numbers(path, data, "xy", (21, 2)) * photo.shrink
    _check_points(f'{path}: "xy"', xy, photo)
    world = _numbers(path, data, "world", (21, 3), REACH) if "world" in data else None
    if world is not None and np.ptp(world, axis=0).max() < MIN_WORLD:
        least = f"{1000 * MIN_WORLD:.0f} mm"
        raise InputError(f'{path}: "world": all points lie within {least}; give those of a hand, in metres.')
    return Landmarks(real(xy), None if world is None else real(world), side, 1.0, 1.0, "file")


def _pose(path: Path, data: dict[str, Any], side: Side, photo: Photo, hand: HandModel) -> HandFit:
    height, width = photo.rgb.shape[:2]
    rotation = _numbers(path, data, "orientation", (3, 3))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise InputError(f'{path}: "orientation" must be a rotation matrix (orthonormal, determinant 1); correct it.')
    translation = _numbers(path, data, "translation", (3,), DEPTHS[1])
    if translation[2] <= DEPTHS[0]:
        raise InputError(f'{path}: "translation" puts the hand behind the camera; z points forward, in metres.')
    longer = max(width, height)
    focal = float(_numbers(path, data, "focal", ())) * photo.shrink
    if not FOCALS[0] * longer <= focal <= FOCALS[1] * longer:
        low, high = (factor * longer / photo.shrink for factor in FOCALS)
        raise InputError(
            f'{path}: "focal" must be a positive number of pixels, {low:.0f} to {high:.0f} for this photo; correct it.'
        )
    size = hand.shape_basis.shape[2]
    shape = _numbers(path, data, "shape", (size,), MAX_SHAPE) if "shape" in data else np.zeros(size)
    centre = np.array([width, height]) / 2
    if "centre" in data:
        centre = _numbers(path, data, "centre", (2,), FOCALS[1] * longer / photo.shrink) * photo.shrink
    pose = HandPose(real(_numbers(path, data, "angles", (15, 3), MAX_ANGLE)), real(rotation), real(translation))
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    camera = Camera(torch.eye(4), real(K), width, height)
    return _checked_fit(path, hand, photo, side, shape, pose, camera)


def _checked_fit(
    path: Path, hand: HandModel, photo: Photo, side: Side, shape: np.ndarray, pose: HandPose, camera: Camera
) -> HandFit:
    """The fit of a pose that puts the hand into the photo."""
    width = camera.width
    kinematics = HandKinematics(hand)
    state = _state(kinematics, side, shape, pose, camera)
    points = kinematics.landmarks(kinematics.pose_joints(state.angles, state.shape))[0]
    if state.in_camera(points)[:, 2].min() <= DEPTHS[0]:
        raise InputError(f'{path}: "translation" puts fingers behind the camera; z points forward, in metres.')
    xy = state.project(points)
    xy[:, 0] = width - xy[:, 0] if side == "left" else xy[:, 0]
    _check_points(f"{path}: this pose and camera", xy, photo)
    return fit_of_pose(hand, photo, side, shape, pose, camera)


def _check_points(name: str, xy: np.ndarray, photo: Photo) -> None:
    """Refuse landmarks that show no hand of the photo."""
    height, width = photo.rgb.shape[:2]
    if not ((xy >= 0) & (xy <= [width, height])).all(1).any():
        raise InputError(f"{name}: none of the points lies in {photo.name}; give pixels of the upright photo.")
    beyond = FAR_OUT * max(width, height)
    if not ((xy >= -beyond) & (xy <= np.array([width, height]) + beyond)).all():
        raise InputError(f"{name}: a point lies far beyond the border of {photo.name}; give pixels of the whole photo.")
    if np.ptp(xy, 0).max() < MIN_PIXELS:
        raise InputError(f"{name}: all points lie within {MIN_PIXELS} pixels; give 21 different ones of a hand.")


def _state(
    kinematics: HandKinematics, side: Side, shape: np.ndarray, pose: HandPose, camera: Camera
) -> FitState:
    """`mirrored_state` with all 45 angles of the pose."""
    table = np.concatenate([np.zeros((1, 3)), pose.angles.double().numpy()])
    return replace(mirrored_state(kinematics, side, shape, pose, camera), angles=table)


def fit_of_pose(
    hand: HandModel, photo: Photo, side: Side, shape: np.ndarray, pose: HandPose, camera: Camera
) -> HandFit:
    """The fit of a given pose: only the mask is estimated from the photo.

    The landmarks are the model's own, so their error is zero.

    Args:
        hand: The model that `shape` and `pose` belong to.
        photo: The photo.
        side: Side of the hand; a left hand's pose describes the mirrored model.
        shape: Coefficients, [S].
        pose: In the camera's frame.
        camera: Camera of the photo, with an identity viewmat.
    """
    kinematics = HandKinematics(hand)
    state = _state(kinematics, side, shape, pose, camera)
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
        reading=surface_reading(reading, view),
    )


def _read_object(path: Path) -> dict[str, Any]:
    try:
        if not path.is_file():
            found = "a folder" if path.is_dir() else "a device or pipe" if path.exists() else "no such file"
            raise InputError(f"{path}: expected a JSON file of one hand, found {found}; check the name.")
        if path.stat().st_size > MAX_LETTERS:
            raise InputError(f"{path}: expected a JSON file of one hand, got more than 1 MB; give the right file.")
        return read_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the name and the permissions.") from error
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}; see docs/estimator.md for the format.") from error


def _numbers(
    path: Path, data: dict[str, Any], key: str, shape: tuple[int, ...], most: float = MAX_NUMBER
) -> np.ndarray:
    """The numbers of a key, none beyond `most` in size."""
    expected = " x ".join(map(str, shape)) + " numbers" if shape else "a number"
    if key not in data:
        raise InputError(f'{path}: the key "{key}" is missing; add {expected}.')
    try:
        values = np.array(data[key])
    except ValueError:
        values = np.array(None)
    if values.dtype.kind not in "iuf" or values.shape != shape or not np.isfinite(values).all():
        raise InputError(f'{path}: "{key}" must be {expected}, all finite; correct it.')
    if np.abs(values.astype(np.float64)).max() > most:
        raise InputError(f'{path}: "{key}" must be {expected} from {-most:.6g} to {most:.6g}; correct it.')
    return values.astype(np.float64)
