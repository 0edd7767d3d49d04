"""Projected Gaussians -> image and alpha, differentiable in their places, shapes, opacities, colours, backgrounds."""

from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels import constants
from oasis_kernels.rasterize.tiles_cuda import INDEX_BITS
from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime import blend_cuda, blend_strips, blend_tiles
from oasis_warp.ops._runtime.launch import has_vectors
from oasis_warp.ops._runtime.registration import adjoint, differentiable, needs_gradient, operator
from oasis_warp.ops._runtime.splats import Frame, Splats, Wanted
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops.projection import Projection


def _way(colors: Tensor) -> ModuleType:
    """How Gaussians with these colours [C, N, D] are drawn."""
    if has_vectors(colors):
        return blend_strips
    if colors.is_cuda and colors.dtype == torch.float32 and colors.shape[1] <= 1 << INDEX_BITS:
        return blend_cuda
    return blend_tiles


# Sizes and flags come in lists: torch takes time for every argument of an op.
def _blend(
    means2d: Tensor,
    covars2d: Tensor,
    opacities: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    records: Tensor,
    frame: list[int],
    keep: bool,
    validate: bool,
) -> tuple[Tensor, Tensor, list[Tensor]]:
    if validate:
        shared = colors.stride(0) == 0  # by the cameras: each value counts once
        check_finite(colors=colors[:1] if shared else colors, backgrounds=backgrounds)
    splats = Splats(records, opacities.contiguous(), colors.contiguous(), backgrounds.contiguous())
    image, alphas, kept = _way(colors).draw(splats, Frame(*frame), keep)
    return image, alphas, [] if kept is None else list(kept)


def _blend_fake(
    means2d: Tensor,
    covars2d: Tensor,
    opacities: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    records: Tensor,
    frame: list[int],
    keep: bool,
    validate: bool,
) -> tuple[Tensor, Tensor, list[Tensor]]:
    n_cameras, _, channels = colors.shape
    width, height, _ = frame
    image, alphas = (colors.new_empty(n_cameras, height, width, k) for k in (channels, 1))
    return image, alphas, list(_way(colors).kept_like(colors, Frame(*frame))) if keep else []


def _blend_backward(
    g_image: Tensor | None,
    g_alpha: Tensor | None,
    splats: list[Tensor],
    kept: list[Tensor],
    frame: list[int],
    wanted: list[bool],
) -> list[Tensor]:
    drawn = Splats(*(t.contiguous() for t in splats))
    incoming = [None if g is None else g.contiguous() for g in (g_image, g_alpha)]
    way = _way(drawn.colors)
    gradients = way.draw_backward(*incoming, drawn, Frame(*frame), way.Kept(*kept), Wanted(*wanted))
    return [drawn.colors.new_empty(0) if g is None else g for g in gradients]


def _blend_backward_fake(
    g_image: Tensor | None,
    g_alpha: Tensor | None,
    splats: list[Tensor],
    kept: list[Tensor],
    frame: list[int],
    wanted: list[bool],
) -> list[Tensor]:
    colors = Splats(*splats).colors
    n_cameras, n, channels = colors.shape
    by = Wanted(*wanted)
    gradients = [
        (by.shape, (n_cameras, n, 2), colors.dtype),
        (by.shape, (n_cameras, n, 3), torch.float64),
        (by.shape, (n_cameras, n), colors.dtype),
        (by.colors, (n_cameras, n, channels), colors.dtype),
        (by.backgrounds, (n_cameras, channels), colors.dtype),
    ]
    return [
        colors.new_empty(shape, dtype=dtype) if asked else colors.new_empty(0) for asked, shape, dtype in gradients
    ]


_forward = operator("blend", _blend, _blend_fake)
_adjoint = adjoint("blend_backward", _blend_backward, _blend_backward_fake)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
    _, _, opacities, colors, backgrounds, records, ctx.frame, _, _ = inputs
    ctx.save_for_backward(records, opacities, colors, backgrounds, *output[2])
    ctx.bytes = None if is_traced() else [t.untyped_storage().nbytes() for t in output[2]]
    ctx.set_materialize_grads(False)


def _back(ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None, _kept: Any) -> tuple[Any, ...]:
    by_means2d, by_covars2d, by_opacities, by_colors, by_backgrounds = needs = ctx.needs_input_grad[:5]
    wanted = [by_means2d or by_covars2d or by_opacities, by_colors, by_backgrounds]
    gradients: Any = (None,) * 5
    if g_image is not None or g_alpha is not None:
        saved = ctx.saved_tensors
        if ctx.bytes is not None and ctx.bytes != [t.untyped_storage().nbytes() for t in saved[4:]]:
            raise RuntimeError(
                "rasterization: expected the tensors that it saved, got copies, which lack what is hidden behind them. "
                "Draw outside of hooks that move saved tensors, such as torch.autograd.graph.save_on_cpu."
            )
        gradients = _adjoint(g_image, g_alpha, list(saved[:4]), list(saved[4:]), ctx.frame, wanted)
    return (
        *(g if need else None for g, need in zip(gradients, needs, strict=True)),
        None,  # records
        None,  # frame
        None,  # keep
        None,  # validate
    )


differentiable(_forward, _back, _save)


def blend(
    projection: Projection,
    opacities: Float[Tensor, "C N"],
    colors: Float[Tensor, "C N D"],
    backgrounds: Float[Tensor, "C D"],
    width: int,
    height: int,
    tile_size: int,
    *,
    validate: bool = False,
) -> tuple[Float[Tensor, "C H W D"], Float[Tensor, "C H W 1"]]:
    """Images over the backgrounds, and alpha (Kerbl et al. 2023, eq. 3): sum of c alpha T, and sum of alpha T.

    D is at most 32. `projection.means2d` and `projection.covars2d` receive gradients.

    Raises:
        ValueError: with `validate`, colours or backgrounds that are not finite.
    """
    channels = colors.shape[-1]
    padding = next(c for c in constants.CHANNELS if c >= channels) - channels
    if padding:
        colors = torch.nn.functional.pad(colors, (0, padding))
        backgrounds = torch.nn.functional.pad(backgrounds, (0, padding))
    means2d, covars2d = projection.means2d, projection.covars2d
    image, alphas, _ = _forward(
        means2d, covars2d, opacities, colors, backgrounds, projection.records, [width, height, tile_size],
        needs_gradient(means2d, covars2d, opacities, colors, backgrounds), validate,
    )  # fmt: skip
    return (image[..., :channels] if padding else image), alphas
