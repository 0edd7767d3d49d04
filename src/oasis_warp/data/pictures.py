"""Write rendered pictures."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.atomic import write_file

_ENCODINGS = {
    ".png": (),
    ".webp": (cv2.IMWRITE_WEBP_QUALITY, 101),  # above 100: lossless
    ".jpg": (cv2.IMWRITE_JPEG_QUALITY, 95),
    ".jpeg": (cv2.IMWRITE_JPEG_QUALITY, 95),
}
PICTURE_SUFFIXES = tuple(_ENCODINGS)


def to_uint8(image: Float[Tensor, "H W C"]) -> UInt8[Tensor, "H W C"]:
    """Colours in [0, 1] as bytes on the CPU, rounded; values beyond are clipped."""
    return (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)


def check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    """Check that `path` ends in one of `suffixes`, before any work is spent on it.

    Raises:
        InputError: it does not.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}; rename the output.")


def write_picture(path: Path | str, image: UInt8[Tensor, "H W C"]) -> None:
    """Write RGB or RGBA pixels as PNG, WebP (both exact) or JPEG, by the suffix of `path`; all or nothing.

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
