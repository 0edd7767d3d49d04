"""Colours of Gaussians as cameras see them, from spherical harmonics; differentiable in all that decides on them."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.rasterize import spherical_harmonics as kernels
from oasis_warp.ops._runtime.launch import (
    SCALAR,
    VEC3,
    VEC4,
    current_stream,
    even_cuts,
    has_cuda_kernels,
    launch_ranges,
    run_cuda,
    view,
)
from oasis_warp.ops._runtime.registration import adjoint, differentiable, operator


def _seen(means: Tensor, coefficients: Tensor, viewmats: Tensor, degree: int) -> Tensor:
    colors = _colors_like(means, coefficients, viewmats, degree)
    total = colors.shape[0] * colors.shape[1]
    if not total:
        return colors
    means, coefficients, viewmats = means.contiguous(), coefficients.contiguous(), viewmats.contiguous()
    if has_cuda_kernels(means):
        words = _cuda_words(means, coefficients, viewmats) | {"total": total, "colors": colors.data_ptr()}
        n_blocks = -(-total // kernels.BLOCK)
        run_cuda(kernels.cuda_sh_to_rgb(degree), words, n_blocks, current_stream(means.device))
        return colors
    vec3 = VEC3[means.dtype]
    launch_ranges(
        kernels.sh_to_rgb(SCALAR[means.dtype], degree),
        even_cuts(total),
        [
            view(means, vec3), view(_rows(coefficients), vec3), view(viewmats, VEC4[means.dtype]),
            view(colors.view(-1, 3), vec3),
        ],
        like=means,
    )  # fmt: skip
    return colors


def _cuda_words(means: Tensor, coefficients: Tensor, viewmats: Tensor) -> dict[str, int | float]:
    """Parameters of both CUDA kernels."""
    n_harmonics = coefficients.shape[-2]
    return {
        "n": means.shape[0], "rows": coefficients.numel() // (3 * n_harmonics), "n_harmonics": n_harmonics,
        "means": means.data_ptr(), "coefficients": coefficients.data_ptr(), "poses": viewmats.data_ptr(),
    }  # fmt: skip


def _rows(coefficients: Tensor) -> Tensor:
    """Coefficients [N, K, 3] or [C, N, K, 3] without an axis of cameras."""
    return coefficients.view(-1, *coefficients.shape[-2:])


def _colors_like(means: Tensor, coefficients: Tensor, viewmats: Tensor, degree: int) -> Tensor:
    return means.new_empty((viewmats.shape[0], means.shape[0], 3))


def _seen_backward(
    g_colors: Tensor,
    colors: Tensor,
    means: Tensor,
    coefficients: Tensor,
    viewmats: Tensor,
    degree: int,
    wanted: list[bool],
) -> tuple[Tensor, Tensor, Tensor]:
    g_means, g_coefficients, g_viewmats = _gradients(
        g_colors, colors, means, coefficients, viewmats, degree, wanted
    )
    n_cameras, n, _ = colors.shape
    if not colors.numel():
        return g_means.zero_(), g_coefficients.zero_(), g_viewmats.zero_()
    means, coefficients, viewmats, g_colors = (
        t.contiguous() for t in (means, coefficients, viewmats, g_colors)
    )
    g_centers = means.new_empty((n_cameras * n if wanted[2] else 0, 3), dtype=torch.float64)
    if has_cuda_kernels(means):
        # The address of an empty tensor is null, by which the kernel knows what is not wanted.
        words = _cuda_words(means, coefficients, viewmats) | {
            "n_cameras": n_cameras, "colors": colors.data_ptr(), "g_colors": g_colors.data_ptr(),
            "g_means": g_means.data_ptr(), "g_coefficients": g_coefficients.data_ptr(),
            "g_centers": g_centers.data_ptr(),
        }  # fmt: skip
        n_blocks = -(-n // kernels.BLOCK)
        run_cuda(kernels.cuda_sh_to_rgb_backward(degree), words, n_blocks, current_stream(means.device))
    else:
        vec3 = VEC3[means.dtype]
        launch_ranges(
            kernels.sh_to_rgb_backward(SCALAR[means.dtype], degree),
            even_cuts(n),
            [
                view(means, vec3), view(_rows(coefficients), vec3), view(viewmats, VEC4[means.dtype]),
                view(colors.view(-1, 3), vec3), view(g_colors.view(-1, 3), vec3), view(g_means, vec3),
                view(_rows(g_coefficients), vec3), view(g_centers, VEC3[torch.float64]),
            ],
            like=means,
        )  # fmt: skip
    if wanted[2]:
        _fill_viewmats(g_viewmats, viewmats.detach().double(), g_centers.view(n_cameras, n, 3).sum(1))
    return g_means, g_coefficients, g_viewmats


def _fill_viewmats(g_viewmats: Tensor, viewmats: Tensor, g_centers: Tensor) -> None:
    """Gradient by poses A | t from those [C, 3] by the centres c = -A^-1 t: -y c^T and -y, with A^T y the latter."""
    turn, shift = viewmats[:, :3, :3], viewmats[:, :3, 3:]
    centers, _ = torch.linalg.solve_ex(turn, -shift)
    y, _ = torch.linalg.solve_ex(turn.mT, g_centers[..., None])
    g_viewmats[:, :3, :3] = -y @ centers.mT
    g_viewmats[:, :3, 3:] = -y
    g_viewmats[:, 3] = 0


def _gradients(
    g_colors: Tensor,
    colors: Tensor,
    means: Tensor,
    coefficients: Tensor,
    viewmats: Tensor,
    degree: int,
    wanted: list[bool],
) -> tuple[Tensor, Tensor, Tensor]:
    """Memory for the gradients that are `wanted`, and tensors without rows for the others."""
    by_means, by_coefficients, by_viewmats = (
        t.new_empty((t.shape[0] if asked else 0, *t.shape[1:]))
        for t, asked in zip((means, coefficients, viewmats), wanted, strict=True)
    )
    return by_means, by_coefficients, by_viewmats


_forward = operator("sh_to_rgb", _seen, _colors_like)
_adjoint = adjoint("sh_to_rgb_backward", _seen_backward, _gradients)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.degree = inputs
    ctx.save_for_backward(output, *tensors)


def _back(ctx: Any, g_colors: Tensor) -> tuple[Tensor | None, ...]:
    wanted = list(ctx.needs_input_grad[:3])
    found = _adjoint(g_colors, *ctx.saved_tensors, ctx.degree, wanted)
    return (
        *(g if asked else None for g, asked in zip(found, wanted, strict=True)),
        None,  # degree
    )


differentiable(_forward, _back, _save)


def sh_to_rgb(
    sh_degree: int,
    means: Float[Tensor, "N 3"],
    coefficients: Float[Tensor, "N K 3"] | Float[Tensor, "C N K 3"],
    viewmats: Float[Tensor, "C 4 4"],
) -> Float[Tensor, "C N 3"]:
    """Colours max(0, 0.5 + harmonics) of Gaussians at `means` from where each camera is (Kerbl et al. 2023).

    Directions are worked out in float64, for a far camera's centre cancels against the means in float32. Values are not
    looked at: bad ones come out as bad colours, which blending refuses by that name.
    """
    return _forward(means, coefficients, viewmats, sh_degree)
