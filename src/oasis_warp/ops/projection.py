"""Gaussians and cameras -> what the rasterizer draws, differentiable in means, quats, scales and viewmats."""

import ctypes
from typing import Any, NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Float64, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_kernels import projection as kernels
from oasis_warp.ops._launch import SCALAR, VEC2, VEC3, VEC4, even_cuts, launch_ranges, start, view

CAMERA_SUM_BLOCK = 1024
"""Gaussians whose camera gradients one thread adds up; fixed, so that the sum does not depend on threads."""


class Projection(NamedTuple):
    """Gaussians on the image planes of C cameras. A Gaussian that is not drawn has radius 0 and zeros."""

    means2d: Float[Tensor, "C N 2"]
    """Centres [px]."""
    covars2d: Float64[Tensor, "C N 3"]
    """Covariances xx, xy, yy with the low-pass [px^2]; float64, or the gradient of a needle would cancel."""
    depths: Float[Tensor, "C N"]
    """Camera z, of Gaussians that are not drawn too."""
    conics: Float[Tensor, "C N 3"]
    """Inverse covariances xx, xy, yy; for reading, without gradient, as all below."""
    radii: Int32[Tensor, "C N 2"]
    """Half the sides of the box outside which the Gaussian is fainter than 1/255 [px], rounded up."""
    sort_depths: Float64[Tensor, "C N"]
    """Camera z as computed, to sort by."""
    centers: Float[Tensor, "C N 4"]
    """means2d as whole x, whole y, remainder x, remainder y."""
    whitenings: Float[Tensor, "C N 4"]
    """Rows of W with W^T W the inverse covariance."""
    boxes: Int32[Tensor, "C N 4"]
    """Pixels x0, y0, x1, y1 (past the end) that the Gaussian can reach."""


def as_float32(value: float) -> float:
    """`value` rounded to float32, so that float32 and float64 calls take the same decisions by it."""
    return ctypes.c_float(value).value


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        viewmats: Tensor,
        opacities: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        near_plane: float,
        far_plane: float,
        radius_clip: float,
        eps2d: float,
    ) -> tuple[Tensor, ...]:
        n, n_cameras, dtype = len(means), len(viewmats), means.dtype

        def empty(*shape: int, dtype: torch.dtype = dtype) -> Tensor:
            return torch.empty(n_cameras, n, *shape, dtype=dtype, device=means.device)

        out = Projection(
            means2d=empty(2),
            covars2d=empty(3, dtype=torch.float64),
            depths=empty(),
            conics=empty(3),
            radii=empty(2, dtype=torch.int32),
            sort_depths=empty(dtype=torch.float64),
            centers=empty(4),
            whitenings=empty(4),
            boxes=empty(4, dtype=torch.int32),
        )
        if n and n_cameras:
            start()
            vec2, vec3, vec4 = VEC2[dtype], VEC3[dtype], VEC4[dtype]
            launch_ranges(
                kernels.project(SCALAR[dtype]),
                even_cuts(n_cameras * n),
                [
                    n, view(means, vec3), view(quats, vec4), view(scales, vec3), view(opacities), view(viewmats),
                    view(Ks), width, height, as_float32(near_plane), as_float32(far_plane), as_float32(eps2d),
                    float(radius_clip),
                    view(out.means2d.view(-1, 2), vec2), view(out.covars2d.view(-1, 3), VEC3[torch.float64]),
                    view(out.conics.view(-1, 3), vec3), view(out.depths.view(-1)), view(out.sort_depths.view(-1)),
                    view(out.radii.view(-1, 2), wp.vec2i), view(out.centers.view(-1, 4), vec4),
                    view(out.whitenings.view(-1, 4), vec4), view(out.boxes.view(-1, 4), wp.vec4i),
                ],
                like=means,
            )  # fmt: skip
        ctx.size = width, height
        ctx.save_for_backward(means, quats, scales, viewmats, Ks, out.radii)
        ctx.mark_non_differentiable(*out[3:])
        ctx.set_materialize_grads(False)
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means2d: Tensor | None, g_covars2d: Tensor | None, g_depths: Tensor | None, *_: None):
        means, quats, scales, viewmats, Ks, radii = ctx.saved_tensors
        n, n_cameras, dtype = len(means), len(viewmats), means.dtype
        float64 = torch.float64

        def given(gradient: Tensor | None, *shape: int, dtype: torch.dtype = dtype) -> Tensor:
            if gradient is None:
                return torch.zeros(n_cameras * n, *shape, dtype=dtype, device=means.device)
            return gradient.contiguous().view(n_cameras * n, *shape)

        g_means, g_quats, g_scales = (torch.empty_like(t) for t in (means, quats, scales))
        with_cameras = ctx.needs_input_grad[3]
        g_cameras = torch.zeros(n_cameras * n if with_cameras else 0, 12, dtype=float64, device=means.device)
        if n:
            vec2, vec3, vec4 = VEC2[dtype], VEC3[dtype], VEC4[dtype]
            launch_ranges(
                kernels.project_backward(SCALAR[dtype]),
                even_cuts(n),
                [
                    n, n_cameras, view(means, vec3), view(quats, vec4), view(scales, vec3), view(viewmats), view(Ks),
                    *ctx.size, view(radii.view(-1, 2), wp.vec2i), view(given(g_means2d, 2), vec2),
                    view(given(g_covars2d, 3, dtype=float64), VEC3[float64]), view(given(g_depths)),
                    int(with_cameras), view(g_means, vec3), view(g_quats, vec4), view(g_scales, vec3), view(g_cameras),
                ],
                like=means,
            )  # fmt: skip
        g_viewmats = None
        if with_cameras:
            g_viewmats = torch.zeros_like(viewmats)
            sums = _sum_rows(_sum_rows(g_cameras, n, CAMERA_SUM_BLOCK), -(-n // CAMERA_SUM_BLOCK), max(n, 1))
            g_viewmats[:, :3] = sums.view(n_cameras, 3, 4).to(dtype) if n else 0.0
        return (
            g_means if ctx.needs_input_grad[0] else None,
            g_quats if ctx.needs_input_grad[1] else None,
            g_scales if ctx.needs_input_grad[2] else None,
            g_viewmats,
            None,  # opacities: they decide what is drawn, and no more
            None,  # Ks
            None,  # width
            None,  # height
            None,  # near_plane
            None,  # far_plane
            None,  # radius_clip
            None,  # eps2d
        )


def _sum_rows(values: Tensor, n: int, block: int) -> Tensor:
    """Sums of blocks of rows of each group of `n` rows, in order."""
    if n == 0:
        return values
    tasks = len(values) // n * -(-n // block)
    sums = torch.empty(tasks, values.shape[1], dtype=values.dtype, device=values.device)
    launch_ranges(
        kernels.sum_blocks, [0, tasks], [n, block, view(values), view(sums)], like=values, lanes=values.shape[1]
    )
    return sums


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    viewmats: Float[Tensor, "C 4 4"],
    Ks: Float[Tensor, "C 3 3"],
    width: int,
    height: int,
    *,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
) -> Projection:
    """The Gaussians on each camera's image plane; arguments as in `rasterization`, which has checked them."""
    return Projection(
        *_Project.apply(
            means.contiguous(), quats.contiguous(), scales.contiguous(), viewmats.contiguous(),
            opacities.detach().contiguous(), Ks.detach().contiguous(), width, height,
            near_plane, far_plane, radius_clip, eps2d,
        )
    )  # fmt: skip
