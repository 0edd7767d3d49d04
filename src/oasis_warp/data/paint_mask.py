"""Find what was painted on a photo: the difference of two pictures without the noise of saving and scaling."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Photo

ASPECT_PIXELS = 1.5
"""Tolerance of a scaled copy's proportions, since sides are rounded [px]."""
CERTAIN, POSSIBLE = 0.1, 0.03
"""Colour difference above which a pixel is paint, and above which it is if connected to such a pixel."""
CERTAIN_NOISE, POSSIBLE_NOISE = 12.0, 4.0
"""The same thresholds in units of the noise, where these are larger."""
BUSY_SHARES = (0.25, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
"""Quantiles of local contrast that divide the pixels into bins: compression changes edges most."""
BUSY_WINDOW = 9
"""Window of local contrast, about a JPEG block [px]."""
QUIET_SHARE = 0.3
"""Share of a bin's pixels that are unpainted in any drawing; their differences determine the noise."""
HALO_SHARE, HALO_WINDOW = 0.2, 17
"""Differences below this share of the largest one in this window [px] are halos of compression, not paint."""
SMALLEST = 4
"""Fewest certain pixels of a stroke or dot."""
RIM = 2
"""Width of the soft edge of paint [px]."""


def match_size(photo: Photo, width: int, height: int, name: str) -> Float[Tensor, "H W 3"]:
    """Scale `photo` to the size of the picture `name`, in [0, 1].

    Raises:
        InputError: the sizes have different proportions.
    """
    rows, columns = photo.rgb.shape[:2]
    if abs(columns * height / rows - width) > ASPECT_PIXELS and abs(rows * width / columns - height) > ASPECT_PIXELS:
        raise InputError(
            f"{name}: {width} x {height} pixels are no scaled copy of {photo.name} with {columns} x {rows}; paint on "
            "the whole photo, without cutting or turning it."
        )
    return _scaled(photo.rgb.float() / 255, width, height)


def _scaled(picture: Tensor, width: int, height: int) -> Tensor:
    rows, columns = picture.shape[:2]
    if (rows, columns) == (height, width):
        return picture
    how = cv2.INTER_AREA if width < columns else cv2.INTER_CUBIC
    return torch.from_numpy(cv2.resize(picture.numpy(), (width, height), interpolation=how)).clamp(0, 1)


def read_mask(mask: Photo, width: int, height: int) -> Float[Tensor, "H W"]:
    """Scale a user's mask, white or opaque where there is paint, to another size.

    Raises:
        InputError: the sizes have different proportions.
    """
    same = match_size(mask, width, height, "the painted picture")
    return same.mean(-1) if mask.alpha is None else _scaled(mask.alpha, width, height)


def find_paint(photo: Float[Tensor, "H W 3"], painted: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Share of each pixel of `painted` that is paint, from its difference to `photo`.

    The noise of compression and scaling is measured on the pair itself, for each bin of local contrast. Paint consists
    of pixels far above the noise and of pixels above the noise that are connected to them.
    """
    apart = np.abs(photo.numpy() - painted.numpy()).max(-1)
    noise = _noise(photo.numpy(), cv2.GaussianBlur(apart, (0, 0), 1.0))
    near = HALO_SHARE * cv2.dilate(apart, np.ones((HALO_WINDOW, HALO_WINDOW), np.uint8))
    possible = (apart > np.maximum(np.maximum(POSSIBLE, near), POSSIBLE_NOISE * noise)).astype(np.uint8)
    certain = apart > np.maximum(CERTAIN, CERTAIN_NOISE * noise)
    # Close gaps in strokes where the paint has the colour of the photo.
    joined = cv2.morphologyEx(possible, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(joined, connectivity=8)
    sure = np.bincount(labels[certain], minlength=count)
    is_paint = sure >= SMALLEST
    is_paint[0] = False
    paint = is_paint[labels].astype(np.uint8)
    size = 2 * RIM + 1
    grown = cv2.dilate(paint, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return torch.from_numpy(cv2.GaussianBlur(grown.astype(np.float32), (0, 0), RIM / 3))


def _noise(photo: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Typical difference without paint at each pixel."""
    window = np.ones((BUSY_WINDOW, BUSY_WINDOW), np.uint8)
    busy = (cv2.dilate(photo, window) - cv2.erode(photo, window)).max(-1)
    bins = np.searchsorted(np.quantile(busy, BUSY_SHARES), busy)
    quiet = np.zeros(len(BUSY_SHARES) + 1, np.float32)
    for k in np.unique(bins):
        quiet[k] = np.quantile(apart[bins == k], QUIET_SHARE)
    return quiet[bins]
