"""Read untrusted JSON: one object of bounded length and depth, without NaN; and cameras from it."""

import json
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.rotation import is_rotation
from oasis_warp.core.types import Camera
from oasis_warp.data.photo import read_bytes

MAX_LETTERS = 1 << 20
"""Longest text; headers, poses and settings have a few thousand letters."""


def read_json(text: str | bytes) -> dict[str, Any]:
    """The object that `text` holds.

    Raises:
        ValueError: too long, no JSON, nested too deeply, with numbers that are none, or no object.
    """
    if len(text) > MAX_LETTERS:
        raise ValueError(f"expected at most {MAX_LETTERS >> 20} MB of JSON, got {len(text) >> 20} MB")
    try:
        value = json.loads(text, parse_constant=_refuse)
    except RecursionError:
        raise ValueError("expected JSON, got lists within lists without end") from None
    except ValueError as error:  # also undecodable bytes, and numbers of thousands of digits
        raise ValueError(f"expected JSON, got something else: {shortened(str(error))}") from None
    if not isinstance(value, dict):
        raise ValueError(f"expected a JSON object, got {type(value).__name__}")
    return value


def whole(value: object, low: int, high: int) -> TypeGuard[int]:
    """Whether a value of JSON is a whole number from `low` to `high`; `true` is none."""
    return type(value) is int and low <= value <= high


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is no number")


MAX_SIDE = 8192
"""Largest side of a picture [px]."""


def read_cameras(path: Path | str) -> list[Camera]:
    """The cameras of a JSON object with `viewmat`, [4, 4] or [T, 4, 4], `K`, [3, 3], `width` and `height`.

    They may stand below a key `camera`, as in what `oasis export -o hand.json` writes. World to camera, OpenCV's axes.

    Raises:
        InputError: no such file, or no cameras.
    """
    path = Path(path)
    try:
        data = read_json(read_bytes(path, "a camera"))
        data = data["camera"] if isinstance(data.get("camera"), dict) else data
        width, height = data.get("width"), data.get("height")
        if not whole(width, 16, MAX_SIDE) or not whole(height, 16, MAX_SIDE):
            raise ValueError(f"`width` and `height` from 16 to {MAX_SIDE} are expected")
        viewmats, K = _numbers(data, "viewmat"), _numbers(data, "K")
        viewmats = viewmats[None] if viewmats.ndim == 2 else viewmats
        if viewmats.ndim != 3 or viewmats.shape[1:] != (4, 4) or not len(viewmats) or K.shape != (3, 3):
            raise ValueError("`viewmat` of [4, 4] or [T, 4, 4] and `K` of [3, 3] are expected")
        if not all(bool(is_rotation(torch.from_numpy(R))) for R in viewmats[:, :3, :3]) or K[0, 0] * K[1, 1] <= 0:
            raise ValueError("rotations in `viewmat` and positive focal lengths in `K` are expected")
    except InputError:
        raise
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: not a camera ({error}); see docs/viewing.md for the format.") from error
    return [Camera(torch.from_numpy(each).float(), torch.from_numpy(K).float(), width, height) for each in viewmats]


def _numbers(data: dict[str, Any], key: str) -> np.ndarray:
    values = np.asarray(data.get(key), dtype=np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"finite numbers in `{key}` are expected")
    return values
