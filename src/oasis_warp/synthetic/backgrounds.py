"""Pictures from a folder as backgrounds instead of rooms."""

import functools
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif")
CACHED = 64
"""Decoded pictures that are cached."""
MAX_PIXELS = 1_000_000
"""Larger pictures are scaled down: no background shows more pixels."""


def list_backgrounds(folder: Path) -> tuple[Path, ...]:
    """The pictures of a folder, sorted by name. Each is opened once to check that it can be read.

    Raises:
        InputError: the folder does not exist or holds no pictures, or a picture cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of pictures, found none; give one that exists.")
    paths = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")))
    if not paths:
        raise InputError(
            f"{folder}: expected pictures ({', '.join(SUFFIXES[:4])} ...), found none; choose another folder."
        )
    for path in paths:
        read_photo(path, max_pixels=MAX_PIXELS)
    return paths


@functools.lru_cache(CACHED)
def _picture(path: Path) -> np.ndarray:
    """Linear RGB."""
    rgb = read_photo(path, max_pixels=MAX_PIXELS).rgb.numpy().astype(np.float32) / 255
    return np.where(rgb < 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def cut_background(paths: tuple[Path, ...], rng: np.random.Generator, size: int, blur: float) -> Float[Tensor, "H W 3"]:
    """A random square of a random picture, maybe mirrored, in linear light with mean 0.3; `blur` is in pixels."""
    picture = _picture(paths[rng.integers(len(paths))])
    height, width = picture.shape[:2]
    side = max(1, int(min(height, width) * rng.uniform(0.5, 1.0)))
    top, left = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
    cut = picture[top : top + side, left : left + side]
    if rng.random() < 0.5:
        cut = cut[:, ::-1]
    cut = cv2.resize(cut, (size, size), interpolation=cv2.INTER_AREA if side > size else cv2.INTER_LINEAR)
    cut = cv2.GaussianBlur(cut, (0, 0), max(blur, 0.3))
    return torch.from_numpy(np.ascontiguousarray(cut * (0.3 / max(float(cut.mean()), 0.02))))
