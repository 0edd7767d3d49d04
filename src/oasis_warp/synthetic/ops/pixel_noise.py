"""Random numbers that depend on one seed per image and nothing else."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import pixel_noise as kernels
from oasis_warp.ops._runtime.launch import launch_ranges
from oasis_warp.ops.checks import check_shape
from oasis_warp.synthetic.ops.views import integers


def pixel_noise(seeds: Int[Tensor, "B"], *shape: int) -> Float[Tensor, "B ..."]:
    """Standard normal float32 numbers of `shape` for each of the seeds, equal on all devices up to rounding.

    Raises:
        ValueError: `seeds` is not a row.
    """
    check_shape("seeds", seeds, "B")
    n = math.prod(shape)
    out = torch.empty((len(seeds), n), device=seeds.device)
    launch_ranges(kernels.normal, out.numel(), [integers(seeds), n, out], like=out)
    return out.unflatten(1, shape)
