"""Fields over the vertices of a surface, read at places between them."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding_bag

from oasis_kernels.posing import corner_reading as kernels
from oasis_warp.ops._runtime.launch import launch


class Corners(NamedTuple):
    """How N places of a surface read a field over its vertices; a place at a vertex may name it three times."""

    index: Int[Tensor, "N 3"]
    """int32."""
    weights: Float[Tensor, "N 3"]


def read_corners(values: Float[Tensor, "*B V D"], corners: Corners) -> Float[Tensor, "*B N D"]:
    """The sums sum_k w_k values[corner k] at N places, for one field or many; indices are trusted.

    Differentiable by the values; gradients add up in a fixed order.
    """
    weights = corners.weights.to(values)
    if values.requires_grad and torch.is_grad_enabled():
        parts = zip(corners.index.unbind(1), weights[..., None].unbind(1), strict=True)
        first, second, third = (values.index_select(-2, index) * weight for index, weight in parts)
        return first + second + third
    if not values.is_cuda:
        rows = values.detach().movedim(-2, 0)
        read = embedding_bag(corners.index, rows.flatten(1), per_sample_weights=weights, mode="sum")
        return read.unflatten(1, rows.shape[1:]).movedim(0, -2)
    # On CUDA embedding_bag takes more than ten times as long.
    fields = values.detach().contiguous().view(-1, *values.shape[-2:])
    out = values.new_empty(len(fields), len(corners.index), values.shape[-1])
    inputs = [fields, corners.index.contiguous(), weights.contiguous(), out]
    launch(kernels.read, out.shape[:2], inputs, like=values)
    return out.view(*values.shape[:-2], *out.shape[1:])
