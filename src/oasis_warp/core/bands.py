"""Values on part of a picture by the size of their detail: differences of Gaussians that do not see past the part."""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor

SIGMAS = (1.0, 2.0, 4.0, 8.0)
"""Standard deviations of the Gaussians between the bands [px]."""


def split_bands(values: Float[Tensor, "*B H W"], weight: Float[Tensor, "*B H W"]) -> Float[Tensor, "*B 4 H W"]:
    """`values` in four bands, finest first, where `weight` is not 0; what has no weight adds nothing.

    Each Gaussian is a normalised convolution (Knutsson and Westin 1993).
    """
    levels = [values, *(_smooth(values, weight, sigma) for sigma in SIGMAS)]
    return torch.stack([fine - coarse for fine, coarse in itertools.pairwise(levels)], -3)


def _smooth(values: Tensor, weight: Tensor, sigma: float) -> Tensor:
    rows, columns = (_gaussian(n, sigma, values) for n in values.shape[-2:])
    total = rows @ weight @ columns
    return (rows @ (values * weight) @ columns) / total.clamp_min(1e-12)


def _gaussian(size: int, sigma: float, like: Tensor) -> Float[Tensor, "n n"]:
    """Weights of a Gaussian from each pixel of a line to each other; the normalised convolution scales them."""
    x = torch.arange(size, dtype=torch.float64, device=like.device)
    return torch.exp(-0.5 * ((x[:, None] - x) / sigma) ** 2).to(like)
