"""View-dependent colours from spherical harmonics, differentiable in directions and coefficients."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.rasterize import spherical_harmonics as kernels
from oasis_warp.core.checks import check_float
from oasis_warp.ops._runtime.launch import SCALAR, VEC3, even_cuts, launch_ranges, view
from oasis_warp.ops._runtime.registration import adjoint, differentiable, operator
from oasis_warp.ops._runtime.values import check_finite

MAX_DEGREE = 3


def _evaluate(directions: Tensor, coefficients: Tensor, degree: int, validate: bool) -> Tensor:
    if validate:
        check_finite(directions=directions, coefficients=coefficients)
    out = torch.empty_like(directions, memory_format=torch.contiguous_format)
    vec3 = VEC3[directions.dtype]
    launch_ranges(
        kernels.evaluate(SCALAR[directions.dtype], degree),
        even_cuts(len(directions)),
        [view(directions.contiguous(), vec3), view(coefficients.contiguous(), vec3), view(out, vec3)],
        like=directions,
    )
    return out


def _evaluate_backward(
    g_out: Tensor, directions: Tensor, coefficients: Tensor, degree: int, by_directions: bool, by_coefficients: bool
) -> tuple[Tensor, Tensor]:
    n, n_coefficients, _ = coefficients.shape
    g_directions = directions.new_empty(n if by_directions else 0, 3)
    g_coefficients = coefficients.new_zeros(n if by_coefficients else 0, n_coefficients, 3)
    vec3 = VEC3[directions.dtype]
    launch_ranges(
        kernels.evaluate_backward(SCALAR[directions.dtype], degree),
        even_cuts(n),
        [
            view(directions.contiguous(), vec3), view(coefficients.contiguous(), vec3), view(g_out.contiguous(), vec3),
            view(g_directions, vec3), view(g_coefficients, vec3),
        ],
        like=directions,
    )  # fmt: skip
    return g_directions, g_coefficients


def _fake_backward(
    g_out: Tensor, directions: Tensor, coefficients: Tensor, degree: int, by_directions: bool, by_coefficients: bool
) -> tuple[Tensor, Tensor]:
    n, n_coefficients, _ = coefficients.shape
    return (
        directions.new_empty(n if by_directions else 0, 3),
        coefficients.new_empty(n if by_coefficients else 0, n_coefficients, 3),
    )


_forward = operator(
    "spherical_harmonics",
    _evaluate,
    lambda directions, coefficients, degree, validate: torch.empty_like(
        directions, memory_format=torch.contiguous_format
    ),
)
_backward = adjoint("spherical_harmonics_backward", _evaluate_backward, _fake_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    directions, coefficients, ctx.degree, _validate = inputs
    ctx.save_for_backward(directions, coefficients)


def _differentiate(ctx: Any, g_out: Tensor) -> tuple[Tensor | None, ...]:
    by_directions, by_coefficients = ctx.needs_input_grad[:2]
    g_directions, g_coefficients = _backward(g_out, *ctx.saved_tensors, ctx.degree, by_directions, by_coefficients)
    return (
        g_directions if by_directions else None,
        g_coefficients if by_coefficients else None,
        None,  # degree
        None,  # validate
    )


differentiable(_forward, _differentiate, _save)


def check_degree(name: str, degree: int, n_coefficients: int) -> None:
    """Refuse a degree that is not built in, or that has more harmonics than there are coefficients.

    Raises:
        ValueError: it is so.
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
    """Sums of real spherical harmonics, sum_k c_k Y_k(d / |d|), as gsplat's function of the same name.

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
    flat = _forward(
        directions.expand(*batch, 3).reshape(-1, 3),
        coefficients.expand(*batch, n_coefficients, 3).reshape(-1, n_coefficients, 3),
        degree,
        validate,
    )
    return flat.view(*batch, 3)
