"""Colours of Gaussians in the light of the vertices around them in one kernel: many steps of torch in `avatar.pose`."""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import gaussian_light as kernels
from oasis_warp.ops._runtime.launch import (
    block_count,
    contiguous,
    current_stream,
    phase_state,
    run_cuda,
    run_native,
    task_count,
)
from oasis_warp.ops.corner_reading import Corners


class OpenFolds(NamedTuple):
    """Folds at M of N Gaussians, as `avatar.folds.Folds`, in a pose; indices are int32."""

    row: Int[Tensor, "N"]
    """Of the fold at each Gaussian, -1 for none."""
    opened: Float[Tensor, "B J 2"]
    """How far joints open folds that the photo shows, and painted ones."""
    joints: Int[Tensor, "M 2"]
    between: Float[Tensor, "M 1"]
    painted: Float[Tensor, "M 1"]
    change: Float[Tensor, "M 3"]


class StretchedSkin(NamedTuple):
    """Creases and wrinkles at K of N Gaussians, as `avatar.creases.Creases`, in a pose; indices are int32."""

    row: Int[Tensor, "N"]
    """Of the crease at each Gaussian, -1 for none."""
    share: Float[Tensor, "B V"]
    """How flat creases are at vertices; below 0, how deep wrinkles are."""
    change: Float[Tensor, "K 3"]
    wrinkles: Float[Tensor, "K 3"]


@torch.no_grad()
def light_gaussians(
    columns: Float[Tensor, "B V 5"],
    corners: Corners,
    colors: Float[Tensor, "N 3"],
    shade: Float[Tensor, "N 3"] | None,
    bounds: tuple[float, float],
    folds: OpenFolds | None = None,
    creases: StretchedSkin | None = None,
) -> Float[Tensor, "B N 3"]:
    """The colours that `avatar.pose.lit_in_steps` describes; float32, values and indices are trusted.

    Not differentiable. The same in a batch as alone, to the bit.

    Args:
        columns: Factors and shares of shade of the vertices, by `ops.vertex_light.light_vertices`.
        corners: Vertices around each Gaussian.
        colors: Of the Gaussians in even light.
        shade: Of the Gaussians.
        bounds: Differences of shade from 1 up to which it is weak, and from which it is deep.
        folds: That bent joints open.
        creases: That stretched skin flattens, and wrinkles of compressed skin.
    """
    batch, n = len(columns), len(colors)
    row, opened, joints, between, painted, fold_change = contiguous(*(folds or [None] * 6))
    crease, stretched, crease_change, wrinkles = contiguous(*(creases or [None] * 4))
    index, weights, columns, colors, shade = contiguous(*corners, columns, colors, shade)
    out = colors.new_empty(batch, n, 3)
    params = {
        "batch": batch, "n_vertices": columns.shape[1], "n": n, "n_joints": 0 if opened is None else opened.shape[1],
        "bounds": _bounds(bounds, colors.device), "columns": columns, "corners": index, "weights": weights,
        "colors": colors, "shade": shade, "folds": row, "opened": opened, "joints": joints, "between": between,
        "painted": painted, "fold_change": fold_change, "creases": crease,
        "stretched": stretched, "crease_change": crease_change, "wrinkles": wrinkles, "out": out,
    }  # fmt: skip
    if colors.is_cuda:
        run_cuda(
            kernels.light_gaussians_cuda, params, block_count(batch * n, kernels.BLOCK), current_stream(colors.device)
        )
    else:
        run_native(kernels.light_gaussians, params | {"state": phase_state(kernels.STATE)}, task_count(batch * n))
    return out


@functools.cache
def _bounds(bounds: tuple[float, float], device: torch.device) -> Float[Tensor, "2"]:
    """Kept, because a graph must not copy them from the host."""
    with torch.inference_mode(False):
        return torch.tensor(bounds, device=device)
