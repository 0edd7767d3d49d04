"""Cut a square out of a photo and resample it."""

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
    """The square as `size` pixels: averaged where it shrinks, bilinear where it grows; black beyond the photo."""
    scale = size / side
    pixels = image.numpy()
    if scale < 1:  # blur to the new pixel size first: a plain lookup would alias
        sigma = 0.5 * (1 / scale**2 - 1) ** 0.5
        pixels = cv2.GaussianBlur(pixels, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    matrix = np.array([[scale, 0, -left * scale + 0.5 * scale - 0.5], [0, scale, -top * scale + 0.5 * scale - 0.5]])
    return torch.from_numpy(cv2.warpAffine(pixels, matrix, (size, size), flags=cv2.INTER_LINEAR))
