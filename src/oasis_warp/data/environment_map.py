"""Read environment maps: equirectangular pictures of the light from all around."""

import re
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.image_header import is_png, pixels_of_png, read_header
from oasis_warp.data.photo import read_bytes

LARGEST = 256
"""Rows to which a map is scaled down: nine harmonics need no more."""
GAMMA = 2.2
"""Gamma of pictures with 8 or 16 bits."""
MAX_PIXELS = 1 << 26
"""Most pixels of a map: 11,000 x 5,500, decoded .8 GB."""
_RADIANCE = re.compile(rb"\A#\?.{0,4000}?\n\n-Y (\d{1,6}) \+X (\d{1,6})\n", re.DOTALL)


def read_environment(path: Path | str) -> Float[Tensor, "H W 3"]:
    """The linear light of an equirectangular picture, twice as wide as high.

    A Radiance .hdr holds linear light; a PNG, JPEG, WebP, BMP or TIFF is read too.

    Raises:
        InputError: the file is missing or no such picture, or shows no light.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an environment map (.hdr), or photo, even or studio.")
    data = read_bytes(path, "an environment map")
    size = _size(data)
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{path}: {size[0]} x {size[1]} pixels are too many to decode; scale the map down first.")
    try:
        decoded = np.frombuffer(pixels_of_png(data) if is_png(data) else data, np.uint8)
        pixels = None if size is None else cv2.imdecode(decoded, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
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
        raise InputError(f"{path}: expected finite values of at least 0, not all 0; give another file.")
    if height > LARGEST:
        light = cv2.resize(light, (2 * LARGEST, LARGEST), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.ascontiguousarray(light))


def _size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a Radiance picture, or of a photo whose header says its size; None of others."""
    if found := _RADIANCE.match(data):
        return int(found[2]), int(found[1])
    header = read_header(data)
    return None if header is None or header.format == "AVIF" else (header.width, header.height)
