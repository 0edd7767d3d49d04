"""Projected Gaussians -> image and alpha, differentiable in their places, shapes, opacities, colours, backgrounds."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels import constants
from oasis_kernels.strips import RECORD
from oasis_warp.core.checks import check_finite
from oasis_warp.ops import _blend_strips as strips
from oasis_warp.ops import _blend_tiles as tiles
from oasis_warp.ops._blend_tiles import Splats
from oasis_warp.ops._registration import (
    adjoint,
    differentiable,
    hidden,
    hidden_like_fake,
    needs_gradient,
    operator,
)
from oasis_warp.ops._tiles import Tiles
from oasis_warp.ops.projection import Projection


class Kept(NamedTuple):
    """What the adjoint needs, as strips (S) or tiles (T) have it; all empty where there will be none."""

    transmittance: Tensor
    """Of the end. S: [strips * plane]. T: [C, H, W]."""
    stops: Tensor
    """The same shape, int32: place in the list of the first Gaussian that was not drawn."""
    starts: Tensor
    """[strips or tiles + 1], int64: first place of each list."""
    pair_starts: Tensor
    """[M]: number of a Gaussian's first pair. S: int32. T: int64."""
    shares: Tensor
    """S: [strips], int32, in which order strips are drawn. T: [M], int64, how many pairs a Gaussian has."""
    records: Tensor
    """S: [M, 16], float32. T: empty."""
    gaussians: Tensor
    """`hidden`, int32: the lists, nearest first."""
    pairs: Tensor
    """`hidden`, int64. S: empty. T: numbers of the pairs in the lists."""


def draws_strips(like: Tensor) -> bool:
    """Whether there are vector kernels for tensors like this one."""
    return like.device.type == "cpu" and like.dtype == torch.float32


def _nothing_kept(like: Tensor) -> Kept:
    def empty(dtype: torch.dtype) -> Tensor:
        return torch.empty(0, dtype=dtype, device=like.device)

    whole = torch.int32 if draws_strips(like) else torch.int64
    return Kept(
        empty(like.dtype), empty(torch.int32), empty(torch.int64), empty(whole), empty(whole), empty(like.dtype),
        hidden(0, torch.int32, like.device), hidden(0, torch.int64, like.device),
    )  # fmt: skip


def _blend(
    means2d: Tensor,
    covars2d: Tensor,
    opacities: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    depths: Tensor,
    centers: Tensor,
    whitenings: Tensor,
    boxes: Tensor,
    width: int,
    height: int,
    tile_size: int,
    keep: bool,
    validate: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    if validate:
        shared = colors.stride(0) == 0  # by the cameras: each value counts once
        check_finite(colors=colors[:1] if shared else colors, backgrounds=backgrounds)
    splats = Splats(*(t.contiguous() for t in (depths, centers, whitenings, boxes, opacities, colors, backgrounds)))
    if draws_strips(colors):
        cut = strips.cut_strips(colors.shape[0], colors.shape[1], width, height, tile_size)
        drawn = strips.draw(splats, cut, keep)
        lists = drawn.lists
        kept = Kept(
            drawn.transmittance, drawn.stops, lists.starts, lists.pair_starts, lists.order, lists.records, lists.ids,
            hidden(0, torch.int64, colors.device),
        )  # fmt: skip
    else:
        drawn = tiles.draw(splats, width, height, tile_size)
        lists = drawn.tiles
        kept = Kept(
            drawn.transmittance, drawn.stops, lists.starts, lists.pair_starts, lists.pair_counts, colors.new_empty(0),
            lists.gaussians, lists.pairs,
        )  # fmt: skip
    return drawn.image, drawn.alphas, *(kept if keep else _nothing_kept(colors))


def _blend_fake(
    means2d: Tensor,
    covars2d: Tensor,
    opacities: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    depths: Tensor,
    centers: Tensor,
    whitenings: Tensor,
    boxes: Tensor,
    width: int,
    height: int,
    tile_size: int,
    keep: bool,
    validate: bool,
) -> tuple[Tensor, ...]:
    n_cameras, n, channels = colors.shape
    image, alphas = (colors.new_empty(n_cameras, height, width, k) for k in (channels, 1))
    if not keep:
        return image, alphas, *_nothing_kept(colors)
    int32, int64 = torch.int32, torch.int64
    if draws_strips(colors):
        cut = strips.cut_strips(n_cameras, n, width, height, tile_size)
        shape, whole, records = (cut.n_strips * cut.plane,), int32, (n_cameras * n, RECORD)
        lists = shares = cut.n_strips
    else:
        shape, whole, records, shares = (n_cameras, height, width), int64, (0,), n_cameras * n
        lists = n_cameras * -(-width // tile_size) * -(-height // tile_size)
    kept = Kept(
        colors.new_empty(shape),
        colors.new_empty(shape, dtype=int32),
        colors.new_empty(lists + 1, dtype=int64),
        colors.new_empty(n_cameras * n, dtype=whole),
        colors.new_empty(shares, dtype=whole),
        colors.new_empty(records),
        hidden_like_fake(int32, colors.device),
        hidden_like_fake(int64, colors.device),
    )
    return image, alphas, *kept


def _blend_backward(
    g_image: Tensor | None,
    g_alpha: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    depths: Tensor,
    centers: Tensor,
    whitenings: Tensor,
    boxes: Tensor,
    transmittance: Tensor,
    stops: Tensor,
    starts: Tensor,
    pair_starts: Tensor,
    shares: Tensor,
    records: Tensor,
    gaussians: Tensor,
    pairs: Tensor,
    width: int,
    height: int,
    tile_size: int,
    with_shape: bool,
    with_colors: bool,
    with_backgrounds: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    splats = Splats(*(t.contiguous() for t in (depths, centers, whitenings, boxes, opacities, colors, backgrounds)))
    incoming = [None if g is None else g.contiguous() for g in (g_image, g_alpha)]
    wanted = with_shape, with_colors, with_backgrounds
    if draws_strips(colors):
        cut = strips.cut_strips(colors.shape[0], colors.shape[1], width, height, tile_size)
        lists = strips.Lists(records, starts, pair_starts, shares, gaussians)
        gradients = strips.draw_backward(*incoming, splats, cut, transmittance, stops, lists, *wanted)
    else:
        across, down = -(-width // tile_size), -(-height // tile_size)
        lists = Tiles(tile_size, across, down, starts, gaussians, pairs, pair_starts, shares)
        gradients = tiles.draw_backward(*incoming, splats, transmittance, stops, lists, *wanted)
    return tuple(colors.new_empty(0) if g is None else g for g in gradients)


def _blend_backward_fake(
    g_image: Tensor | None,
    g_alpha: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    depths: Tensor,
    centers: Tensor,
    whitenings: Tensor,
    boxes: Tensor,
    transmittance: Tensor,
    stops: Tensor,
    starts: Tensor,
    pair_starts: Tensor,
    shares: Tensor,
    records: Tensor,
    gaussians: Tensor,
    pairs: Tensor,
    width: int,
    height: int,
    tile_size: int,
    with_shape: bool,
    with_colors: bool,
    with_backgrounds: bool,
) -> tuple[Tensor, ...]:
    n_cameras, n, channels = colors.shape
    none = colors.new_empty(0)
    covars2d = colors.new_empty(n_cameras, n, 3, dtype=torch.float64)
    return (
        colors.new_empty(n_cameras, n, 2) if with_shape else none,
        covars2d if with_shape else colors.new_empty(0),
        colors.new_empty(n_cameras, n) if with_shape else colors.new_empty(0),
        colors.new_empty(n_cameras, n, channels) if with_colors else colors.new_empty(0),
        colors.new_empty(n_cameras, channels) if with_backgrounds else colors.new_empty(0),
    )


_forward = operator("blend", _blend, _blend_fake)
_adjoint = adjoint("blend_backward", _blend_backward, _blend_backward_fake)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    _, _, *splats, width, height, tile_size, _, _ = inputs
    ctx.size = width, height, tile_size
    ctx.save_for_backward(*splats, *output[2:])
    ctx.set_materialize_grads(False)


def _back(ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, ...]:
    needs = ctx.needs_input_grad
    wanted = any(needs[:3]), needs[3], needs[4]
    gradients = (None,) * 5
    if g_image is not None or g_alpha is not None:
        gradients = _adjoint(g_image, g_alpha, *ctx.saved_tensors, *ctx.size, *wanted)
    # None for depths, centers, whitenings, boxes, width, height, tile_size, keep and validate.
    return *(g if need else None for g, need in zip(gradients, needs[:5], strict=True)), *(None,) * 9


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
    image, alphas, *_ = _forward(
        means2d, covars2d, opacities, colors, backgrounds, projection.sort_depths, projection.centers,
        projection.whitenings, projection.boxes, width, height, tile_size,
        needs_gradient(means2d, covars2d, opacities, colors, backgrounds), validate,
    )  # fmt: skip
    return (image[..., :channels] if padding else image), alphas
