"""Means and maxima over squares of pixels, along rows, then columns: the cost grows with a side, not with the area."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d


def mean_around(planes: Float[Tensor, "*B H W"], pixels: int) -> Float[Tensor, "*B H W"]:
    """The mean over the pixels up to `pixels` away along both axes. Pixels beyond the picture count as 0."""
    rows = planes.reshape(-1, 1, *planes.shape[-2:])
    for _ in range(2):  # along rows, where memory is contiguous, then turned
        rows = avg_pool2d(rows, (1, 2 * pixels + 1), stride=1, padding=(0, pixels)).mT.contiguous()
    return rows.view(planes.shape)


def largest_around(planes: Float[Tensor, "*B H W"], pixels: int) -> Float[Tensor, "*B H W"]:
    """The largest value up to `pixels` away along both axes."""
    rows = planes.reshape(-1, 1, *planes.shape[-2:])
    for _ in range(2):
        rows = max_pool2d(rows, (1, 2 * pixels + 1), stride=1, padding=(0, pixels)).mT.contiguous()
    return rows.view(planes.shape)


def smooth_mean_around(
    values: Float[Tensor, "H W D"], weight: Float[Tensor, "H W"], pixels: int
) -> Float[Tensor, "H W D"]:
    """Weighted mean of the values around each pixel, with a square's mean taken twice; 0 where there is no weight."""
    planes = torch.cat([values * weight[..., None], weight[..., None]], -1).permute(2, 0, 1)
    for _ in range(2):
        planes = mean_around(planes, pixels)
    return (planes[:-1] / planes[-1:].clamp_min(1e-6)).permute(1, 2, 0)
