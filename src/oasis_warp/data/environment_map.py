"""Read environment maps: equirectangular pictures of the light from all around."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError

LARGEST = 256
"""Rows to which a map is scaled down: nine harmonics need no more."""
GAMMA = 2.2
"""Of pictures with 8 or 16 bits."""


def read_environment(path: Path | str) -> Float[Tensor, "H W 3"]:
    """The linear light of an equirectangular picture: Radiance .hdr, or any that OpenCV reads, twice as wide as high.

    Raises:
        InputError: the file is missing or no such picture, or shows no light.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an environment map (.hdr), or photo, even or studio.")
    pixels = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.ndim != 3 or pixels.shape[2] < 3:
        raise InputError(f"{path}: expected an environment map in colour, such as a Radiance .hdr; give another file.")
    height, width = pixels.shape[:2]
    if width != 2 * height:
        raise InputError(
            f"{path}: expected an equirectangular map, twice as wide as high, got {width} x {height}; convert it."
        )
    light = pixels[..., 2::-1].astype(np.float32)
    if pixels.dtype != np.float32:
        light = (light / np.iinfo(pixels.dtype).max) ** GAMMA
    if not np.isfinite(light).all() or light.min() < 0 or light.max() <= 0:
        raise InputError(f"{path}: expected light from 0 up, got none, or values that are no light; give another file.")
    if height > LARGEST:
        light = cv2.resize(light, (2 * LARGEST, LARGEST), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.ascontiguousarray(light))
