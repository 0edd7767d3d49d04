"""Light on the vertices of posed surfaces in one kernel: forty steps of torch in `avatar.vertex_light`."""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import vertex_light as kernels
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

Triple = tuple[float, float, float]


class Rules(NamedTuple):
    """The constants of these names in `avatar.sky` and `avatar.vertex_light`, in the order of `vertex_light.h`."""

    gamma: float
    least_light: Triple
    in_hollows: Triple
    in_crevices: Triple
    deep_inside: float
    outside: float
    turned_away: float
    as_in_photo: float
    other_pose: float
    same_pose: float
    same_sky: float
    other_sky: float
    same_beside: float
    other_beside: float
    weak: float
    deep: float


class InPhoto(NamedTuple):
    """What a photo shows of each vertex, as in `HandLight` and `SurfaceLight`."""

    facing: Float[Tensor, "V 3"]
    shade: Float[Tensor, "V 3"] | None
    doubt: Float[Tensor, "V"] | None
    seen: Float[Tensor, "V"] | None
    """Share of the sky; None where shade does not depend on it, and without exposure."""


class Coarse(NamedTuple):
    """A coarse mesh over which changes of the sky spread, as `avatar.sky.SkyMesh`; indices are int32."""

    vertices: Int[Tensor, "C"]
    nearby: Int[Tensor, "C N"]
    corners: Corners


@torch.no_grad()
def light_vertices(
    normals: Float[Tensor, "B V 3"],
    harmonics: Float[Tensor, "K 3"],
    limits: Float[Tensor, "2 3"],
    rules: Rules,
    coarse: Coarse,
    exposure: Float[Tensor, "B V 4"] | None = None,
    albedo: Float[Tensor, "3"] | None = None,
    closeness: Float[Tensor, "B V"] | None = None,
    photo: InPhoto | None = None,
    viewed: Float[Tensor, "B 2"] | None = None,
) -> Float[Tensor, "B V 5"]:
    """Factors of the vertices' sRGB colours, then the shares of deep and of weak shade, 0 without a `photo`.

    Args are those of `avatar.vertex_light`, float32; exposure comes with the albedo. Values and indices are
    trusted; not differentiable. The same in a batch as alone, to the bit on the CPU.
    """
    batch, n = normals.shape[:2]
    n_coarse, n_nearby = coarse.nearby.shape
    normals, harmonics, limits, exposure, albedo = contiguous(normals, harmonics, limits, exposure, albedo)
    closeness, viewed, facing, shade, doubt, seen = contiguous(closeness, viewed, *(photo or [None] * 4))
    vertices, nearby, corners, weights = contiguous(coarse.vertices, coarse.nearby, *coarse.corners)
    out = normals.new_empty(batch, n, 5)
    params = {
        "batch": batch, "n_vertices": n, "n_coarse": n_coarse, "n_nearby": n_nearby, "n_harmonics": len(harmonics),
        "rules": _rules(rules, normals.device), "normals": normals, "harmonics": harmonics, "limits": limits,
        "exposure": exposure, "albedo": albedo, "closeness": closeness, "in_photo": facing, "seen": seen,
        "doubt": doubt, "viewed": viewed, "shade": shade, "coarse": vertices, "nearby": nearby, "corners": corners,
        "weights": weights, "agreement": normals.new_empty(batch, kernels.PARTS),
        "opened": normals.new_empty(batch, n_coarse), "out": out,
    }  # fmt: skip
    if normals.is_cuda:
        stream = current_stream(normals.device)
        if photo:
            blocks = batch * kernels.PARTS + block_count(batch * n_coarse * 32, kernels.PREPARE_BLOCK)
            run_cuda(kernels.prepare, params, blocks if n else 0, stream)
        run_cuda(kernels.light_vertices_cuda, params, block_count(batch * n, kernels.BLOCK), stream)
    else:
        run_native(kernels.light_vertices, params | {"state": phase_state(kernels.STATE)}, task_count(batch * n))
    return out


@functools.cache
def _rules(rules: Rules, device: torch.device) -> Float[Tensor, "R"]:
    """Kept, because a graph must not copy them from the host."""
    numbers = [number for value in rules for number in (value if isinstance(value, tuple) else (value,))]
    with torch.inference_mode(False):
        return torch.tensor(numbers, device=device)
