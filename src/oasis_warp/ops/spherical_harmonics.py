"""Spherical harmonics: values in given directions, and colours of Gaussians as cameras see them; differentiable."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.rasterize import spherical_harmonics as kernels
from oasis_warp.ops._runtime.declaration import Array, Operator, empty_gradients
from oasis_warp.ops._runtime.launch import (
    SCALAR,
    block_count,
    contiguous,
    current_stream,
    has_cuda_kernels,
    launch_ranges,
    run_cuda,
    vectors,
)
from oasis_warp.ops.checks import check_float, check_tensor

MAX_DEGREE = 3


def _evaluate(directions: Tensor, coefficients: Tensor, degree: int, validate: bool) -> Tensor:
    out = torch.empty_like(directions, memory_format=torch.contiguous_format)
    inputs = [vectors(directions.contiguous()), vectors(coefficients.contiguous(), 2), vectors(out)]
    launch_ranges(kernels.evaluate(SCALAR[directions.dtype], degree), len(directions), inputs, like=directions)
    return out


def _evaluate_fake(directions: Tensor, coefficients: Tensor, degree: int, validate: bool) -> Tensor:
    return torch.empty_like(directions, memory_format=torch.contiguous_format)


def _evaluate_backward(
    directions: Tensor, coefficients: Tensor, degree: int, g_values: Tensor, needs: list[bool]
) -> list[Tensor]:
    gradients = empty_gradients((directions, coefficients), needs)
    gradients[1].zero_()
    directions, coefficients, g_values = contiguous(directions, coefficients, g_values)
    inputs = [
        vectors(directions), vectors(coefficients, 2), vectors(g_values), vectors(gradients[0]),
        vectors(gradients[1], 2),
    ]  # fmt: skip
    launch_ranges(kernels.evaluate_backward(SCALAR[directions.dtype], degree), len(directions), inputs, like=directions)
    return gradients


_OPERATOR = Operator(
    "spherical_harmonics",
    _evaluate,
    _evaluate_fake,
    _evaluate_backward,
    inputs={"directions": Array("N 3", grad=True), "coefficients": Array("N K 3", grad=True)},
    outputs={"values": "N 3"},
)


def check_degree(name: str, degree: int, n_coefficients: int) -> None:
    """Refuse a degree that is not supported, or that has more harmonics than there are coefficients.

    Raises:
        ValueError: names the argument.
    """
    if isinstance(degree, bool) or not isinstance(degree, int) or not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"{name}: expected a degree from 0 to {MAX_DEGREE}, got {degree!r}.")
    if n_coefficients < (degree + 1) ** 2:
        raise ValueError(
            f"{name}: expected at most the degree of {n_coefficients} coefficients, got {degree!r}, "
            f"which takes {(degree + 1) ** 2}."
        )


def spherical_harmonics(
    degree: int,
    directions: Float[Tensor, "*views 3"],
    coefficients: Float[Tensor, "*rows K 3"],
    *,
    validate: bool = True,
) -> Float[Tensor, "*batch 3"]:
    """Sums of real spherical harmonics, sum_k c_k Y_k(d) with d a unit vector, as gsplat's function of the same name.

    The basis and its order are those of 3DGS (Kerbl et al. 2023, section 5): constant, then -y, z, -x, and so on. Add
    0.5 and cut at 0 to get the colours that 3DGS draws; `rasterization` with `sh_degree` does.

    Differentiable, once, in `directions` and `coefficients`.

    Args:
        degree: 0 to 3; the first (degree + 1)^2 coefficients are read.
        directions: From the camera to the Gaussian, any positive length, shape [..., 3].
        coefficients: One colour a harmonic, shape [..., K, 3], broadcast against the directions.
        validate: Refuse values that are not finite. Waits for a CUDA device; switch it off for trusted inputs.

    Raises:
        ValueError: a wrong shape, dtype or degree, or a value that is not finite.
    """
    for name, tensor in (("directions", directions), ("coefficients", coefficients)):
        check_tensor(name, tensor)
    if directions.shape[-1:] != (3,) or coefficients.dim() < 2 or coefficients.shape[-1] != 3:
        raise ValueError(
            "coefficients: expected shapes [..., 3] of directions and [..., K, 3] of coefficients, "
            f"got {list(directions.shape)} and {list(coefficients.shape)}."
        )
    check_float("directions", directions)
    check_float("coefficients", coefficients, like=directions)
    n_coefficients = coefficients.shape[-2]
    check_degree("degree", degree, n_coefficients)
    try:
        batch = torch.broadcast_shapes(directions.shape[:-1], coefficients.shape[:-2])
    except RuntimeError:
        raise ValueError(
            "coefficients: expected leading axes that broadcast against those of directions, "
            f"got {list(coefficients.shape)} and {list(directions.shape)}."
        ) from None
    flat = _OPERATOR(
        directions.expand(*batch, 3).reshape(-1, 3),
        coefficients.expand(*batch, n_coefficients, 3).reshape(-1, n_coefficients, 3),
        degree,
        validate,
    )
    return flat.view(*batch, 3)


def _colors_like(means: Tensor, coefficients: Tensor, viewmats: Tensor, degree: int) -> Tensor:
    return means.new_empty((viewmats.shape[0], means.shape[0], 3))


def _cuda_params(means: Tensor, coefficients: Tensor, viewmats: Tensor, **others: Any) -> dict[str, Any]:
    n_harmonics = coefficients.shape[-2]
    return {
        "n": means.shape[0], "rows": coefficients.numel() // (3 * n_harmonics), "n_harmonics": n_harmonics,
        "means": means, "coefficients": coefficients, "poses": viewmats, **others,
    }  # fmt: skip


def _sh_to_rgb(means: Tensor, coefficients: Tensor, viewmats: Tensor, degree: int) -> Tensor:
    colors = _colors_like(means, coefficients, viewmats, degree)
    total = colors.shape[0] * colors.shape[1]
    if not total:
        return colors
    means, coefficients, viewmats = contiguous(means, coefficients, viewmats)
    if has_cuda_kernels(means):
        params = _cuda_params(means, coefficients, viewmats, total=total, colors=colors)
        n_blocks = block_count(total, kernels.BLOCK)
        run_cuda(kernels.cuda_sh_to_rgb(degree), params, n_blocks, current_stream(means.device))
        return colors
    inputs = [vectors(means), vectors(coefficients, 2), vectors(viewmats, 2), vectors(colors)]
    launch_ranges(kernels.sh_to_rgb(SCALAR[means.dtype], degree), total, inputs, like=means)
    return colors


def _sh_to_rgb_backward(
    means: Tensor, coefficients: Tensor, viewmats: Tensor, colors: Tensor, degree: int, g_colors: Tensor,
    needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    gradients = g_means, g_coefficients, g_viewmats = empty_gradients((means, coefficients, viewmats), needs)
    n_cameras, n, _ = colors.shape
    if not colors.numel():
        return [gradient.zero_() for gradient in gradients]
    means, coefficients, viewmats, g_colors = contiguous(means, coefficients, viewmats, g_colors)
    g_centers = means.new_empty((n_cameras * n if needs[2] else 0, 3), dtype=torch.float64)
    if has_cuda_kernels(means):
        params = _cuda_params(
            means, coefficients, viewmats, n_cameras=n_cameras, colors=colors, g_colors=g_colors, g_means=g_means,
            g_coefficients=g_coefficients, g_centers=g_centers,
        )  # fmt: skip
        n_blocks = block_count(n, kernels.BLOCK)
        run_cuda(kernels.cuda_sh_to_rgb_backward(degree), params, n_blocks, current_stream(means.device))
    else:
        inputs = [
            vectors(means), vectors(coefficients, 2), vectors(viewmats, 2), vectors(colors), vectors(g_colors),
            vectors(g_means), vectors(g_coefficients, 2), vectors(g_centers),
        ]  # fmt: skip
        launch_ranges(kernels.sh_to_rgb_backward(SCALAR[means.dtype], degree), n, inputs, like=means)
    if needs[2]:
        _fill_viewmats(g_viewmats, viewmats.detach().double(), g_centers.view(n_cameras, n, 3).sum(1))
    return gradients


def _fill_viewmats(g_viewmats: Tensor, viewmats: Tensor, g_centers: Tensor) -> None:
    """Gradient by poses A | t from those [C, 3] by the centres c = -A^-1 t: -y c^T and -y, with A^T y the latter."""
    rotation, translation = viewmats[:, :3, :3], viewmats[:, :3, 3:]
    centers, _ = torch.linalg.solve_ex(rotation, -translation)
    y, _ = torch.linalg.solve_ex(rotation.mT, g_centers[..., None])
    g_viewmats[:, :3, :3] = -y @ centers.mT
    g_viewmats[:, :3, 3:] = -y
    g_viewmats[:, 3] = 0


_SH_TO_RGB = Operator(
    "sh_to_rgb",
    _sh_to_rgb,
    _colors_like,
    _sh_to_rgb_backward,
    inputs={
        "means": Array("N 3", grad=True),
        "coefficients": Array("?C N K 3", grad=True),
        "viewmats": Array("C 4 4", grad=True),
    },
    outputs={"colors": "C N 3"},
    reference="rasterization.sh_to_rgb",
    caller="rasterization",
    public=False,
)


def sh_to_rgb(
    sh_degree: int,
    means: Float[Tensor, "N 3"],
    coefficients: Float[Tensor, "N K 3"] | Float[Tensor, "C N K 3"],
    viewmats: Float[Tensor, "C 4 4"],
) -> Float[Tensor, "C N 3"]:
    """Colours max(0, 0.5 + harmonics) of Gaussians at `means`, seen from each camera's centre (Kerbl et al. 2023).

    Directions are computed in float64, because a far camera's centre cancels against the means in float32. Values are
    not checked: bad ones give bad colours, which blending refuses by that name.
    """
    return _SH_TO_RGB(means, coefficients, viewmats, sh_degree)
