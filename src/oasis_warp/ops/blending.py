"""Projected Gaussians -> image and alpha, differentiable in their places, shapes, opacities, colours, backgrounds."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from warp import vec4i
from warp.types import vector

from oasis_kernels import constants
from oasis_kernels import rasterize_backward as backward_kernels
from oasis_kernels import rasterize_forward as forward_kernels
from oasis_kernels import rasterize_rows as row_kernels
from oasis_warp.ops._launch import SCALAR, VEC2, VEC3, VEC4, even_cuts, launch_ranges, start, view
from oasis_warp.ops._tiles import Tiles
from oasis_warp.ops.projection import Projection

CUDA_LANES = 16, 16
"""Lanes across and down a tile on CUDA: with the default tile of 16 pixels, one lane a pixel."""
CUDA_WARP_LANES = 4, 8
"""The same for the backward pass, where the lanes of one warp share a tile."""


def lane_grid(tile_size: int, device: torch.device, grid: tuple[int, int]) -> tuple[int, int, int]:
    """Number of lanes of a tile, and the width and height of their rectangles [px]; one lane on the CPU."""
    if device.type == "cpu":
        return 1, tile_size, tile_size
    across, down = grid
    # The grid keeps its size where the tile does not divide by it; lanes without pixels idle.
    return across * down, -(-tile_size // across), -(-tile_size // down)


def blend_kernel(tensor: Tensor, channels: int) -> Any:
    """The forward kernel for tensors like `tensor`."""
    if tensor.device.type == "cpu" and tensor.dtype == torch.float32:
        return row_kernels.blend(channels)
    return forward_kernels.blend(SCALAR[tensor.dtype], channels)


def blend_backward_kernel(tensor: Tensor, channels: int) -> Any:
    """The backward kernel for tensors like `tensor`."""
    if tensor.device.type == "cpu" and tensor.dtype == torch.float32:
        return row_kernels.blend_backward(channels)
    return backward_kernels.blend_backward(SCALAR[tensor.dtype], channels)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        covars2d: Tensor,
        opacities: Tensor,
        colors: Tensor,
        backgrounds: Tensor,
        projection: Projection,
        tiles: Tiles,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor]:
        n_cameras, _, channels = colors.shape
        dtype, device = colors.dtype, colors.device
        start()
        color, vec4 = vector(channels, SCALAR[dtype]), VEC4[dtype]
        image = torch.empty(n_cameras, height, width, channels, dtype=dtype, device=device)
        transmittance = torch.empty(n_cameras, height, width, 1, dtype=dtype, device=device)
        alphas = torch.empty_like(transmittance)
        stops = torch.empty(n_cameras, height, width, dtype=torch.int32, device=device)
        lanes, lane_width, lane_height = lane_grid(tiles.size, device, CUDA_LANES)
        launch_ranges(
            blend_kernel(colors, channels),
            tiles.cuts,
            [
                view(tiles.starts), view(tiles.gaussians), view(projection.boxes.view(-1, 4), vec4i),
                view(projection.centers.view(-1, 4), vec4), view(projection.whitenings.view(-1, 4), vec4),
                view(opacities.view(-1)), view(colors.view(-1, channels), color), view(backgrounds, color),
                tiles.size, lane_width, lane_height, tiles.across, tiles.down, width, height,
                view(image.view(-1, channels), color), view(alphas.view(-1)), view(transmittance.view(-1)),
                view(stops.view(-1)),
            ],
            like=image,
            lanes=lanes,
        )  # fmt: skip
        ctx.tiles, ctx.size = tiles, (width, height)
        ctx.save_for_backward(
            opacities, colors, backgrounds, transmittance, stops,
            projection.boxes, projection.centers, projection.whitenings,
        )  # fmt: skip
        ctx.set_materialize_grads(False)
        return image, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None) -> tuple[Tensor | None, ...]:
        opacities, colors, backgrounds, transmittance, stops, boxes, centers, whitenings = ctx.saved_tensors
        tiles: Tiles = ctx.tiles
        width, height = ctx.size
        n_cameras, n, channels = colors.shape
        dtype, device = colors.dtype, colors.device
        scalar = SCALAR[dtype]
        color, moments = vector(channels, scalar), vector(6, scalar)
        with_shape = any(ctx.needs_input_grad[:3])
        pixels = n_cameras * height * width

        def empty(*shape: int) -> Tensor:
            return torch.empty(*shape, dtype=dtype, device=device)

        of_image = colors.new_zeros(pixels, channels) if g_image is None else g_image.contiguous().view(-1, channels)
        of_alpha = colors.new_zeros(pixels) if g_alpha is None else g_alpha.contiguous().view(-1)
        pair_moments = empty(len(tiles.pairs) if with_shape else 0, 6)
        pair_colors = empty(len(tiles.pairs), channels)
        tile_backgrounds = empty(len(tiles.starts) - 1, channels)
        lanes, lane_width, lane_height = lane_grid(tiles.size, device, CUDA_WARP_LANES)
        launch_ranges(
            blend_backward_kernel(colors, channels),
            tiles.cuts,
            [
                view(tiles.starts), view(tiles.gaussians), view(tiles.pairs), view(boxes.view(-1, 4), vec4i),
                view(centers.view(-1, 4), VEC4[dtype]), view(whitenings.view(-1, 4), VEC4[dtype]),
                view(opacities.view(-1)), view(colors.view(-1, channels), color), view(backgrounds, color),
                view(stops.view(-1)), view(of_image, color), view(of_alpha),
                tiles.size, lane_width, lane_height, tiles.across, tiles.down, width, height, int(with_shape),
                view(transmittance.view(-1).clone()), view(empty(pixels)),
                view(pair_moments, moments), view(pair_colors, color), view(tile_backgrounds, color),
            ],
            like=colors,
            lanes=lanes,
        )  # fmt: skip

        cuts = even_cuts(n_cameras * n)
        spans = [view(tiles.pair_starts), view(tiles.pair_counts)]
        g_means2d = g_covars2d = g_opacities = g_colors = g_backgrounds = None
        if with_shape:
            g_means2d = empty(n_cameras, n, 2)
            g_covars2d = torch.empty(n_cameras, n, 3, dtype=torch.float64, device=device)
            g_opacities = empty(n_cameras, n)
            launch_ranges(
                backward_kernels.gather_shape(scalar),
                cuts,
                [
                    *spans, view(pair_moments, moments), view(whitenings.view(-1, 4), VEC4[dtype]),
                    view(opacities.view(-1)), view(g_means2d.view(-1, 2), VEC2[dtype]),
                    view(g_covars2d.view(-1, 3), VEC3[torch.float64]), view(g_opacities.view(-1)),
                ],
                like=colors,
            )  # fmt: skip
        if ctx.needs_input_grad[3]:
            g_colors = empty(n_cameras, n, channels)
            launch_ranges(
                backward_kernels.gather_colors(scalar, channels),
                cuts,
                [*spans, view(pair_colors, color), view(g_colors.view(-1, channels), color)],
                like=colors,
            )
        if ctx.needs_input_grad[4]:
            g_backgrounds = empty(n_cameras, channels)
            per_camera = tiles.across * tiles.down
            launch_ranges(
                backward_kernels.sum_backgrounds(scalar, channels),
                [0, n_cameras],
                [per_camera, view(tile_backgrounds, color), view(g_backgrounds, color)],
                like=colors,
            )
        return (
            g_means2d,
            g_covars2d,
            g_opacities,
            g_colors,
            g_backgrounds,
            None,  # projection
            None,  # tiles
            None,  # width
            None,  # height
        )


def blend(
    projection: Projection,
    tiles: Tiles,
    opacities: Float[Tensor, "C N"],
    colors: Float[Tensor, "C N D"],
    backgrounds: Float[Tensor, "C D"],
    width: int,
    height: int,
) -> tuple[Float[Tensor, "C H W D"], Float[Tensor, "C H W 1"]]:
    """Images over the backgrounds, and alpha (Kerbl et al. 2023, eq. 3): sum of c alpha T, and sum of alpha T.

    D is at most 32. `projection.means2d` and `projection.covars2d` receive gradients.
    """
    channels = colors.shape[-1]
    padding = next(c for c in constants.CHANNELS if c >= channels) - channels
    if padding:
        colors = torch.nn.functional.pad(colors, (0, padding))
        backgrounds = torch.nn.functional.pad(backgrounds, (0, padding))
    image, alphas = _Blend.apply(
        projection.means2d, projection.covars2d, opacities.contiguous(), colors.contiguous(),
        backgrounds.contiguous(), projection, tiles, width, height,
    )  # fmt: skip
    return image[..., :channels], alphas
