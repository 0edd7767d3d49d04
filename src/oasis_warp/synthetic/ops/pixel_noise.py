"""Random numbers that depend on one seed per image and nothing else."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import pixel_noise as kernels
from oasis_warp.ops._runtime.declaration import Array, Operator
from oasis_warp.ops._runtime.launch import even_cuts, launch_ranges, view


def _noise(seeds: Tensor, shape: list[int]) -> Tensor:
    n = math.prod(shape)
    out = torch.empty((len(seeds), n), device=seeds.device)
    inputs = [view(seeds.to(torch.int32).contiguous()), n, view(out)]
    launch_ranges(kernels.normal, even_cuts(out.numel()), inputs, like=out)
    return out.unflatten(1, shape)


def _noise_fake(seeds: Tensor, shape: list[int]) -> Tensor:
    return torch.empty((len(seeds), *shape), device=seeds.device)


_OPERATOR = Operator(
    "pixel_noise",
    _noise,
    _noise_fake,
    inputs={"seeds": Array("B", index="any")},
    outputs={"noise": "B ..."},
    public=False,
)


def pixel_noise(seeds: Int[Tensor, "B"], *shape: int) -> Float[Tensor, "B ..."]:
    """Standard normal float32 numbers of `shape` for each of the seeds, equal on all devices up to rounding.

    Raises:
        ValueError: `seeds` is not a row.
    """
    _OPERATOR.check(seeds=seeds)
    return _OPERATOR(seeds, list(shape))
