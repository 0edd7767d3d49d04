"""Random numbers that depend on a seed an image and nothing else."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import pixel_noise as kernels
from oasis_warp.core.checks import check_shape
from oasis_warp.ops._runtime.launch import even_cuts, launch_ranges, view
from oasis_warp.ops._runtime.registration import operator


def _noise(seeds: Tensor, shape: list[int]) -> Tensor:
    n = math.prod(shape)
    out = torch.empty((len(seeds), n), device=seeds.device)
    inputs = [view(seeds.to(torch.int32).contiguous()), n, view(out)]
    launch_ranges(kernels.normal, even_cuts(out.numel()), inputs, like=out)
    return out.unflatten(1, shape)


def _noise_fake(seeds: Tensor, shape: list[int]) -> Tensor:
    return torch.empty((len(seeds), *shape), device=seeds.device)


_op = operator("pixel_noise", _noise, _noise_fake)


def pixel_noise(seeds: Int[Tensor, "B"], *shape: int) -> Float[Tensor, "B ..."]:
    """Standard normal float32 numbers of `shape` for each of the seeds, equal on all devices up to rounding.

    Raises:
        ValueError: `seeds` is not a row.
    """
    check_shape("seeds", seeds, "B")
    return _op(seeds, list(shape))
