"""Read motions: joint angles of many frames, as JSON or npz."""

import json
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError

MOTION_SUFFIXES = (".json", ".npz")
USUAL_FPS = 30.0
MOST_FRAMES = 100_000
LARGEST_ANGLE = 2 * np.pi
"""Beyond it angles are degrees, taken for radians."""


class Motion(NamedTuple):
    """Poses at a fixed rate."""

    angles: Float[Tensor, "T 15 3"]
    """As `HandPose.angles` [rad]."""
    fps: float


def read_motion(path: Path | str) -> Motion:
    """The motion in a JSON object or an npz with `angles`, [T, 15, 3] rad, and `fps`, 30 if there is none.

    Raises:
        InputError: no such file, or not a motion.
    """
    path = Path(path)
    if path.suffix.lower() not in MOTION_SUFFIXES:
        raise InputError(f"{path}: expected a motion in .json or .npz; rename or convert the file.")
    try:
        stored = _read_json(path) if path.suffix.lower() == ".json" else _read_npz(path)
        angles = np.asarray(stored["angles"], dtype=np.float64)
        fps = float(np.asarray(stored.get("fps", USUAL_FPS), dtype=np.float64))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
    except KeyError as error:
        raise InputError(
            f"{path}: expected `angles` in it, found none; write them as [T, 15, 3] in radians."
        ) from error
    except (ValueError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a motion ({_first_line(error)}); write `angles` as [T, 15, 3].") from error
    if angles.ndim != 3 or angles.shape[1:] != (15, 3) or not 1 <= len(angles) <= MOST_FRAMES:
        raise InputError(f"{path}: expected angles of shape [T, 15, 3], got {list(angles.shape)}; change the file.")
    if not np.isfinite(angles).all() or np.abs(angles).max() > LARGEST_ANGLE:
        raise InputError(f"{path}: expected angles in radians, up to {LARGEST_ANGLE:.2f}; change the file.")
    if not 1 <= fps <= 1000:
        raise InputError(f"{path}: expected 1 to 1000 frames a second, got {fps:g}; change its `fps`.")
    return Motion(torch.from_numpy(angles).float(), fps)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:100] if str(error) else type(error).__name__


def _read_json(path: Path) -> dict:
    stored = json.loads(path.read_bytes())
    if not isinstance(stored, dict):
        raise ValueError(f"a JSON object, not a {type(stored).__name__}, is wanted")
    return stored


def _read_npz(path: Path) -> dict:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        return {name: stored[name] for name in ("angles", "fps") if name in stored.files}


def resample(motion: Motion, fps: float) -> list[Float[Tensor, "15 3"]]:
    """Angles of the same motion at another rate, blended between its frames; its last frame is the last shown."""
    last = len(motion.angles) - 1
    count = max(1, round(len(motion.angles) / motion.fps * fps))
    at = [min(k * motion.fps / fps, last) for k in range(count)]
    return [torch.lerp(motion.angles[int(x)], motion.angles[min(int(x) + 1, last)], x - int(x)) for x in at]
