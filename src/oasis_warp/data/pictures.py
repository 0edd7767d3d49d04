"""Write pictures and contact sheets."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_file

_ENCODINGS = {
    ".png": (),
    ".webp": (cv2.IMWRITE_WEBP_QUALITY, 101),  # above 100: lossless
    ".jpg": (cv2.IMWRITE_JPEG_QUALITY, 95),
    ".jpeg": (cv2.IMWRITE_JPEG_QUALITY, 95),
}
PICTURE_SUFFIXES = tuple(_ENCODINGS)


def to_uint8(image: Float[Tensor, "H W C"]) -> UInt8[Tensor, "H W C"]:
    """Colours in [0, 1] as bytes on the CPU, clipped and rounded."""
    return (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)


def check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    """Check that `path` ends in one of `suffixes`, before any work is spent on it.

    Raises:
        InputError: another suffix.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}; rename the output.")


def write_picture(path: Path | str, image: UInt8[Tensor, "H W C"]) -> None:
    """Write RGB or RGBA pixels as PNG, WebP (both exact) or JPEG, by the suffix of `path`, atomically.

    Raises:
        InputError: another suffix, transparency in a JPEG, or `path` cannot be written.
    """
    path = Path(path)
    check_suffix(path, PICTURE_SUFFIXES)
    pixels = image.numpy()
    if pixels.shape[2] == 4 and path.suffix.lower() in (".jpg", ".jpeg"):
        raise InputError(f"{path}: JPEG has no transparency; write PNG or choose a background.")
    order = cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR
    pixels = cv2.cvtColor(np.ascontiguousarray(pixels), order)
    _, data = cv2.imencode(path.suffix.lower(), pixels, _ENCODINGS[path.suffix.lower()])
    write_file(path, data.tobytes())


def contact_sheet(images: Float[Tensor, "N H W 3"], columns: int, gap: int = 2) -> Float[Tensor, "R C 3"]:
    """Arrange pictures in rows of `columns`, with white gaps."""
    n, height, width = images.shape[:3]
    rows = -(-n // columns)
    sheet = torch.ones(rows * (height + gap) - gap, columns * (width + gap) - gap, 3)
    for k, image in enumerate(images.cpu()):
        y, x = k // columns * (height + gap), k % columns * (width + gap)
        sheet[y : y + height, x : x + width] = image
    return sheet
