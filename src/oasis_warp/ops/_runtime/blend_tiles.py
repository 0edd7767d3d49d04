"""Blend tile by tile with the generic kernels: on CUDA, and in float64 on the CPU."""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from warp.types import vector

from oasis_kernels.rasterize import rasterize_backward as backward_kernels
from oasis_kernels.rasterize import rasterize_forward as forward_kernels
from oasis_warp.ops._runtime.launch import SCALAR, launch_ranges, start, vectors, view
from oasis_warp.ops._runtime.records import Frame, GradientFlags, Gradients, Splats
from oasis_warp.ops._runtime.rules import current_rules
from oasis_warp.ops._runtime.tiles import bin_to_tiles, even_work, fake_opaque_buffer, opaque_elements

CUDA_LANES = 16, 16
"""Lanes across and down a tile on CUDA: one per pixel of the default tile of 16 pixels."""
CUDA_WARP_LANES = 4, 8
"""The same for the backward pass, where the lanes of one warp share a tile."""


class SavedTensors(NamedTuple):
    """Tensors saved for the adjoint. P pairs of a Gaussian and a tile."""

    transmittance: Tensor
    """[C, H, W], of the end."""
    stops: Tensor
    """[C, H, W], int32: place in the tile's list of the first Gaussian that was not drawn."""
    starts: Tensor
    """As in `Tiles`, like all below."""
    pair_starts: Tensor
    pair_counts: Tensor
    gaussians: Tensor
    pairs: Tensor


def fake_saved(colors: Tensor, frame: Frame) -> SavedTensors:
    """Empty tensors of the shapes that `draw` saves."""
    n_cameras, n, _ = colors.shape
    width, height, tile_size = frame
    n_tiles = n_cameras * -(-width // tile_size) * -(-height // tile_size)

    def empty(*shape: int, dtype: torch.dtype) -> Tensor:
        return colors.new_empty(shape, dtype=dtype)

    return SavedTensors(
        empty(n_cameras, height, width, dtype=colors.dtype),
        empty(n_cameras, height, width, dtype=torch.int32),
        empty(n_tiles + 1, dtype=torch.int64),
        empty(n_cameras * n, dtype=torch.int64),
        empty(n_cameras * n, dtype=torch.int64),
        fake_opaque_buffer(torch.int32, colors.device),
        fake_opaque_buffer(torch.int64, colors.device),
    )


def lane_grid(tile_size: int, device: torch.device, grid: tuple[int, int]) -> tuple[int, int, int]:
    """Number of lanes of a tile, and the width and height of their rectangles [px]; one lane on the CPU."""
    if device.type == "cpu":
        return 1, tile_size, tile_size
    across, down = grid
    # The grid keeps its size where the tile does not divide by it; lanes without pixels idle.
    return across * down, -(-tile_size // across), -(-tile_size // down)


def splat_views(splats: Splats) -> list[Any]:
    """Arguments boxes, centers, whitenings, opacities of the generic kernels."""
    records = splats.tables()
    tables = records.boxes, records.centers, records.whitenings
    return [*map(vectors, tables), splats.opacities.view(-1)]


def draw(splats: Splats, frame: Frame, keep: bool) -> tuple[Tensor, Tensor, SavedTensors | None]:
    """Images over the backgrounds, alpha, and, with `keep`, what the adjoint needs."""
    width, height, tile_size = frame
    n_cameras, _, channels = splats.colors.shape
    dtype, device = splats.colors.dtype, splats.colors.device
    start()
    color = vector(channels, SCALAR[dtype])
    records = splats.tables()
    tiles = bin_to_tiles(records.boxes, records.sort_depths, width, height, tile_size)
    image = torch.empty(n_cameras, height, width, channels, dtype=dtype, device=device)
    alphas = torch.empty(n_cameras, height, width, 1, dtype=dtype, device=device)
    transmittance = torch.empty(n_cameras, height, width, dtype=dtype, device=device)
    stops = torch.empty(n_cameras, height, width, dtype=torch.int32, device=device)
    lanes, lane_width, lane_height = lane_grid(tile_size, device, CUDA_LANES)
    launch_ranges(
        forward_kernels.blend(SCALAR[dtype], channels, current_rules()),
        even_work(tiles.starts),
        [
            tiles.starts, opaque_elements(tiles.gaussians), *splat_views(splats),
            view(splats.colors.view(-1, channels), color), view(splats.backgrounds, color), tile_size, lane_width,
            lane_height, tiles.across, tiles.down, width, height, view(image.view(-1, channels), color),
            alphas.view(-1), transmittance.view(-1), stops.view(-1),
        ],
        like=image,
        lanes=lanes,
    )  # fmt: skip
    if not keep:
        return image, alphas, None
    lists = tiles.starts, tiles.pair_starts, tiles.pair_counts, tiles.gaussians, tiles.pairs
    return image, alphas, SavedTensors(transmittance, stops, *lists)


def draw_backward(
    g_image: Tensor | None, g_alpha: Tensor | None, splats: Splats, frame: Frame, saved: SavedTensors,
    flags: GradientFlags,
) -> Gradients:  # fmt: skip
    """Gradients from those by image and alpha, None standing for zeros."""
    n_cameras, n, channels = splats.colors.shape
    width, height, tile_size = frame
    transmittance, stops, starts, pair_starts, pair_counts, gaussians, pairs = saved
    across, down = -(-width // tile_size), -(-height // tile_size)
    with_shape, with_colors, with_backgrounds = flags
    dtype, device = splats.colors.dtype, splats.colors.device
    start()
    scalar = SCALAR[dtype]
    color, moments = vector(channels, scalar), vector(6, scalar)
    pixels = n_cameras * height * width

    def empty(*shape: int) -> Tensor:
        return torch.empty(*shape, dtype=dtype, device=device)

    of_image = splats.colors.new_zeros(pixels, channels) if g_image is None else g_image.view(-1, channels)
    of_alpha = splats.colors.new_zeros(pixels) if g_alpha is None else g_alpha.view(-1)
    pair_numbers = opaque_elements(pairs)
    pair_moments = empty(len(pair_numbers) if with_shape else 0, 6)
    pair_colors = empty(len(pair_numbers), channels)
    tile_backgrounds = empty(len(starts) - 1, channels)
    lanes, lane_width, lane_height = lane_grid(tile_size, device, CUDA_WARP_LANES)
    launch_ranges(
        backward_kernels.blend_backward(scalar, channels, current_rules()),
        even_work(starts),
        [
            starts, opaque_elements(gaussians), pair_numbers, *splat_views(splats),
            view(splats.colors.view(-1, channels), color), view(splats.backgrounds, color), stops.view(-1),
            view(of_image, color), of_alpha, tile_size, lane_width, lane_height, across, down, width, height,
            int(with_shape), transmittance.view(-1).clone(), empty(pixels), view(pair_moments, moments),
            view(pair_colors, color), view(tile_backgrounds, color),
        ],
        like=pair_colors,
        lanes=lanes,
    )  # fmt: skip

    g_means2d = g_covars2d = g_opacities = g_colors = g_backgrounds = None
    if with_shape:
        g_means2d, g_covars2d, g_opacities = _gather_shape(splats, saved, pair_moments)
    if with_colors:
        g_colors = empty(n_cameras, n, channels)
        inputs = [pair_starts, pair_counts, view(pair_colors, color), view(g_colors.view(-1, channels), color)]
        launch_ranges(backward_kernels.gather_colors(scalar, channels), n_cameras * n, inputs, like=pair_colors)
    if with_backgrounds:
        g_backgrounds = empty(n_cameras, channels)
        inputs = [across * down, view(tile_backgrounds, color), view(g_backgrounds, color)]
        launch_ranges(backward_kernels.sum_backgrounds(scalar, channels), n_cameras, inputs, like=pair_colors)
    return Gradients(g_means2d, g_covars2d, g_opacities, g_colors, g_backgrounds)


def _gather_shape(splats: Splats, saved: SavedTensors, pair_moments: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients by means2d, covars2d and opacities: sums over the pairs of each Gaussian."""
    like, (n_cameras, n) = splats.opacities, splats.opacities.shape
    dtype = like.dtype
    g_means2d, g_opacities = like.new_empty(n_cameras, n, 2), like.new_empty(n_cameras, n)
    g_covars2d = like.new_empty(n_cameras, n, 3, dtype=torch.float64)
    _, _, whitenings, opacities = splat_views(splats)
    inputs = [
        saved.pair_starts, saved.pair_counts, view(pair_moments, vector(6, SCALAR[dtype])), whitenings, opacities,
        vectors(g_means2d), vectors(g_covars2d), g_opacities.view(-1),
    ]  # fmt: skip
    launch_ranges(backward_kernels.gather_shape(SCALAR[dtype]), n_cameras * n, inputs, like=pair_moments)
    return g_means2d, g_covars2d, g_opacities
