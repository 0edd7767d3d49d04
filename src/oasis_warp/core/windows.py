"""Means and maxima over squares of pixels, along rows, then columns, in times that hardly grow with the square."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad


def mean_around(planes: Float[Tensor, "*B H W"], pixels: int) -> Float[Tensor, "*B H W"]:
    """The mean over the pixels up to `pixels` away along both axes. Pixels beyond the picture count as 0."""
    side = 2 * pixels + 1
    for _ in range(2):  # along rows, where memory is contiguous, then turned
        sums = pad(planes, (pixels + 1, pixels)).cumsum(-1, dtype=torch.float64)
        planes = ((sums[..., side:] - sums[..., :-side]) / side).to(planes.dtype).mT.contiguous()
    return planes


def largest_around(planes: Float[Tensor, "*B H W"], pixels: int) -> Float[Tensor, "*B H W"]:
    """The largest value up to `pixels` away along both axes."""
    side = 2 * pixels + 1
    for _ in range(2):
        planes, width = pad(planes, (pixels, pixels), value=-torch.inf), 1
        while 2 * width <= side:  # the largest of so many from each pixel on
            planes, width = torch.maximum(planes[..., :-width], planes[..., width:]), 2 * width
        rest = side - width
        planes = torch.maximum(planes[..., : planes.shape[-1] - rest], planes[..., rest:]).mT.contiguous()
    return planes


def smooth_mean_around(
    values: Float[Tensor, "H W D"], weight: Float[Tensor, "H W"], pixels: int
) -> Float[Tensor, "H W D"]:
    """Weighted mean of the values around each pixel, with a square's mean taken twice; 0 where there is no weight."""
    planes = torch.cat([values * weight[..., None], weight[..., None]], -1).permute(2, 0, 1)
    for _ in range(2):
        planes = mean_around(planes, pixels)
    return (planes[:-1] / planes[-1:].clamp_min(1e-6)).permute(1, 2, 0)
