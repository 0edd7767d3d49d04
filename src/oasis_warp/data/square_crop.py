"""Crop and resample a square of a photo; find the square of a photo that a picture shows."""

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def square_around(mask: Float[Tensor, "H W"], margin: float) -> tuple[float, float, float]:
    """Left, top and side [px] of the square around the pixels above 0.5, `margin` times their longer extent."""
    rows, columns = np.nonzero(mask.numpy() > 0.5)
    left, right, top, bottom = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    side = margin * max(right - left, bottom - top)
    return (left + right - side) / 2, (top + bottom - side) / 2, side


def resample_square(
    image: Float[Tensor, "H W *C"], left: float, top: float, side: float, size: int
) -> Float[Tensor, "size size *C"]:
    """Resample the square to `size` pixels: filtered when shrinking, else bilinear; black outside the photo."""
    scale = size / side
    pixels = image.numpy()
    if scale < 1:  # blur to the new pixel size first, against aliasing
        sigma = 0.5 * (1 / scale**2 - 1) ** 0.5
        pixels = cv2.GaussianBlur(pixels, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    matrix = np.array([[scale, 0, -left * scale + 0.5 * scale - 0.5], [0, scale, -top * scale + 0.5 * scale - 0.5]])
    return torch.from_numpy(cv2.warpAffine(pixels, matrix, (size, size), flags=cv2.INTER_LINEAR))


SEARCH_SIDE = 128
"""Longer side of the photo in the search over all positions and sizes [px]."""
SIZES = (0.12, 1.6)
"""Smallest and largest square of the search, over the photo's longer side."""
SIZE_STEP = 1.05
BLURS = (4.0, 2.0)
"""Blurs of both pictures during refinement, from coarse to fine [px]; they suppress an avatar's noise."""
RIM = 2
"""Width of the band inside the outline that is ignored, where the avatar differs most [px]."""
ROUNDS = 8
"""Iterations of refinement for each blur."""
MAX_GROWTH = 0.1
"""Largest relative change of the side in one iteration."""
OUTLIER = 0.08
"""Colour difference above which a pixel is down-weighted, as paint or background."""


class Square(NamedTuple):
    """A square of a photo."""

    left: float
    top: float
    side: float
    """All in pixels of the photo."""
    difference: float
    """Median colour difference between the picture and the photo there, in [0, 1]."""


def find_square(picture: Float[Tensor, "S S 3"], alpha: Float[Tensor, "S S"], photo: Float[Tensor, "H W 3"]) -> Square:
    """The square of `photo` that `picture` shows where its `alpha` is above 0.5.

    A search over all positions and sizes in small copies, then Gauss-Newton with Geman-McClure weights.
    """
    inside = cv2.erode((alpha.numpy() > 0.5).astype(np.float32), np.ones((3, 3), np.uint8), iterations=RIM)
    square = _search(picture.numpy(), inside, photo.numpy())
    for blur in BLURS:
        goal = cv2.GaussianBlur(picture.numpy(), (0, 0), blur)
        # Blurring mixes the background across the outline.
        deep = cv2.erode(inside, np.ones((3, 3), np.uint8), iterations=round(2 * blur))
        for _ in range(ROUNDS):
            square = _refine(goal, deep, photo, square, blur)
    apart = np.abs(resample_square(photo, *square, len(picture)).numpy() - picture.numpy()).mean(-1)
    return Square(*square, float(np.median(apart[inside > 0])) if inside.any() else 1.0)


def _search(picture: np.ndarray, inside: np.ndarray, photo: np.ndarray) -> tuple[float, float, float]:
    height, width = photo.shape[:2]
    scale = SEARCH_SIDE / max(height, width)
    small = cv2.resize(photo, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    border = SEARCH_SIDE // 3  # the square may extend beyond the photo, the hand may not
    small = cv2.copyMakeBorder(small, border, border, border, border, cv2.BORDER_REPLICATE)
    best, found = -np.inf, (0.0, 0.0, float(max(height, width)))
    side = SIZES[0] * SEARCH_SIDE
    while side <= SIZES[1] * SEARCH_SIDE:
        n = round(side)
        if n <= min(small.shape[:2]):
            shrunk = cv2.resize(picture, (n, n), interpolation=cv2.INTER_AREA)
            mask = cv2.resize(inside, (n, n), interpolation=cv2.INTER_AREA) > 0.9
            for x, y in _candidates(small, shrunk, mask):
                alike = _likeness(small[y : y + n, x : x + n], shrunk, mask)
                if alike > best:
                    best, found = alike, ((x - border) / scale, (y - border) / scale, n / scale)
        side = max(side * SIZE_STEP, n + 1)
    return found


def _candidates(photo: np.ndarray, picture: np.ndarray, mask: np.ndarray) -> list[tuple[int, int]]:
    """Candidate positions of a picture in the photo: highest correlation, and smallest difference."""
    if not mask.any():
        return []
    weights = np.dstack([mask.astype(np.float32)] * 3)
    alike = cv2.matchTemplate(photo, picture, cv2.TM_CCOEFF_NORMED, mask=weights)
    alike[~(np.abs(alike) <= 1.001)] = -1  # undefined over uniform areas
    apart = cv2.matchTemplate(photo, picture, cv2.TM_SQDIFF, mask=weights)
    (x, y), (left, top) = cv2.minMaxLoc(alike)[3], cv2.minMaxLoc(apart)[2]
    return [(x, y), (left, top)]


def _likeness(crop: np.ndarray, picture: np.ndarray, mask: np.ndarray) -> float:
    """Correlation over the pixels with similar colours, times their share.

    This ignores paint. Differences alone would be smallest for a tiny hand on a patch of plain skin.
    """
    near = mask & (np.abs(crop - picture).mean(-1) < OUTLIER)
    if not near.any():
        return -1.0
    a, b = (plane[near] - plane[near].mean(0) for plane in (crop, picture))
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / max(size, 1e-6) * float(near.sum() / mask.sum())


def _refine(
    goal: np.ndarray, inside: np.ndarray, photo: Tensor, square: tuple[float, float, float], blur: float
) -> tuple[float, float, float]:
    """One Gauss-Newton step on left, top and the logarithm of the side."""
    left, top, side = square
    n = len(goal)
    crop = cv2.GaussianBlur(resample_square(photo, left, top, side, n).numpy(), (0, 0), blur)
    error = crop - goal
    weight = inside / (1 + np.square(error).mean(-1) / OUTLIER**2) ** 2
    across, down = (cv2.Sobel(crop, cv2.CV_32F, *axis, ksize=3, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    # Derivatives with respect to a shift by one pixel of the square, and to growth about its top left corner.
    place = np.arange(n, dtype=np.float32) + 0.5
    grown = across * place[None, :, None] + down * place[:, None, None]
    slopes = np.stack([across, down, grown], -1)
    normal = np.einsum("ijck,ijcl,ij->kl", slopes, slopes, weight)
    right = -np.einsum("ijck,ijc,ij->k", slopes, error, weight)
    right_by, down_by, growth = np.linalg.lstsq(normal, right, rcond=None)[0].tolist()
    pixel = side / n
    return left + right_by * pixel, top + down_by * pixel, side * math.exp(min(max(growth, -MAX_GROWTH), MAX_GROWTH))
