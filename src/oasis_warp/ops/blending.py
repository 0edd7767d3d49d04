"""Projected Gaussians -> image and alpha, differentiable in positions, shapes, opacities, colours and backgrounds."""

from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels import constants
from oasis_kernels.rasterize.tiles_cuda import INDEX_BITS
from oasis_warp.ops._runtime import blend_cuda, blend_strips, blend_tiles
from oasis_warp.ops._runtime.declaration import Array, Operator, needs_gradient
from oasis_warp.ops._runtime.launch import contiguous, has_vectors
from oasis_warp.ops._runtime.records import Frame, GradientFlags, Splats
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops.projection import Projection


def _backend(colors: Tensor) -> ModuleType:
    """The backend that blends Gaussians with these colours [C, N, D]."""
    if has_vectors(colors):
        return blend_strips
    if colors.is_cuda and colors.dtype == torch.float32 and colors.shape[1] <= 1 << INDEX_BITS:
        return blend_cuda
    return blend_tiles


def _splats(records: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor) -> Splats:
    rows = blend_cuda.contiguous if _backend(colors) is blend_cuda else Tensor.contiguous
    return Splats(records, rows(opacities), rows(colors), backgrounds.contiguous())


# Sizes and flags come in lists: each argument of an op costs torch time.
def _blend(
    means2d: Tensor, covars2d: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor, records: Tensor,
    frame: list[int], keep: bool, validate: bool,
) -> tuple[Tensor, Tensor, list[Tensor]]:  # fmt: skip
    if validate:
        shared = colors.stride(0) == 0  # by the cameras: each value counts once
        check_finite(colors=colors[:1] if shared else colors, backgrounds=backgrounds)
    splats = _splats(records, opacities, colors, backgrounds)
    image, alphas, saved = _backend(colors).draw(splats, Frame(*frame), keep)
    return image, alphas, [] if saved is None else list(saved)


def _blend_fake(
    means2d: Any, covars2d: Any, opacities: Any, colors: Tensor, backgrounds: Any, records: Any, frame: list[int],
    keep: bool, validate: bool,
) -> tuple[Tensor, Tensor, list[Tensor]]:  # fmt: skip
    n_cameras, _, channels = colors.shape
    width, height, _ = frame
    image, alphas = (colors.new_empty(n_cameras, height, width, k) for k in (channels, 1))
    return image, alphas, list(_backend(colors).fake_saved(colors, Frame(*frame))) if keep else []


def _blend_backward(
    opacities: Tensor, colors: Tensor, backgrounds: Tensor, records: Tensor, saved: list[Tensor], frame: list[int],
    g_image: Tensor | None, g_alphas: Tensor | None, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    splats = _splats(records, opacities, colors, backgrounds)
    backend, flags = _backend(colors), GradientFlags(any(needs[:3]), *needs[3:])
    gradients = backend.draw_backward(
        *contiguous(g_image, g_alphas), splats, Frame(*frame), backend.SavedTensors(*saved), flags
    )
    return [colors.new_empty(0) if g is None else g for g in gradients]


def _blend_backward_fake(
    opacities: Any, colors: Tensor, backgrounds: Any, records: Any, saved: Any, frame: Any, g_image: Any, g_alphas: Any,
    needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    n_cameras, n, channels = colors.shape
    shape = any(needs[:3])
    gradients = [
        (shape, (n_cameras, n, 2), colors.dtype),
        (shape, (n_cameras, n, 3), torch.float64),
        (shape, (n_cameras, n), colors.dtype),
        (needs[3], (n_cameras, n, channels), colors.dtype),
        (needs[4], (n_cameras, channels), colors.dtype),
    ]
    return [
        colors.new_empty(shape, dtype=dtype) if needed else colors.new_empty(0) for needed, shape, dtype in gradients
    ]


_OPERATOR = Operator(
    "blend",
    _blend,
    _blend_fake,
    _blend_backward,
    _blend_backward_fake,
    inputs={
        "means2d": Array("C N 2", grad=True),
        "covars2d": Array("C N 3", grad=True),
        "opacities": Array("C N", grad=True),
        "colors": Array("C N D", grad=True),
        "backgrounds": Array("C D", grad=True),
    },
    outputs={"image": "C H W D", "alphas": "C H W 1"},
    auxiliary={"saved": "..."},
    validates_itself=True,
    caller="rasterization",
    public=False,
)


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
    image, alphas, _ = _OPERATOR(
        means2d, covars2d, opacities, colors, backgrounds, projection.records, [width, height, tile_size],
        needs_gradient(means2d, covars2d, opacities, colors, backgrounds), validate,
    )  # fmt: skip
    return (image[..., :channels] if padding else image), alphas
