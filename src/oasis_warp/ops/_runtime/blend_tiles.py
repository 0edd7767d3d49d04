"""Blend tile by tile with the generic kernels: on CUDA, and in float64 on the CPU; lists of Gaussians for the tiles."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Int32, Int64
from torch import Tensor
from warp.types import vector

from oasis_kernels.rasterize import rasterize_backward as backward_kernels
from oasis_kernels.rasterize import rasterize_forward as forward_kernels
from oasis_kernels.rasterize import tiles
from oasis_warp.core.processes import kernel_threads
from oasis_warp.ops._runtime.launch import SCALAR, launch_ranges, start, vectors, view
from oasis_warp.ops._runtime.records import Frame, GradientFlags, Gradients, Splats
from oasis_warp.ops._runtime.rules import current_rules

MAX_PAIRS = 2**31 - 1
"""Pairs of a Gaussian and a tile that one call can hold."""
RANGES_PER_THREAD = 4
"""Ranges of tiles per thread, so that none waits long for the last."""
CUDA_LANES = 16, 16
"""Lanes across and down a tile on CUDA: one per pixel of the default tile of 16 pixels."""
CUDA_WARP_LANES = 4, 8
"""The same for the backward pass, where the lanes of one warp share a tile."""


class Tiles(NamedTuple):
    """The Gaussians of each tile, front to back. P pairs of a Gaussian and a tile."""

    size: int
    """Side of a tile [px]."""
    across: int
    down: int
    starts: Int64[Tensor, "tiles_plus_one"]
    """First place of each tile, camera by camera, row by row; at the end P."""
    gaussians: Int32[Tensor, "1"]
    """`opaque_buffer` [P]: camera * N + gaussian at each place."""
    pairs: Int64[Tensor, "1"]
    """`opaque_buffer` [P]: number of the pair at each place; a Gaussian's pairs have consecutive numbers."""
    pair_starts: Int64[Tensor, "M"]
    """First number of each Gaussian's pairs, by camera * N + gaussian."""
    pair_counts: Int64[Tensor, "M"]


def opaque_buffer(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Memory for `size` elements, as `opaque_elements` shows it, in the form of a tensor of one element.

    The one element is at the start of a longer storage: shapes stay known, and the storage travels along.
    """
    return torch.empty(size + 1, dtype=dtype, device=device).resize_(1)


def opaque_elements(buffer: Tensor) -> Tensor:
    """All elements of an `opaque_buffer`."""
    return buffer.as_strided((buffer.untyped_storage().nbytes() // buffer.element_size() - 1,), (1,))


def fake_opaque_buffer(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The visible part of an `opaque_buffer`, for a fake."""
    return torch.empty(1, dtype=dtype, device=device)


def bin_to_tiles(boxes: Tensor, depths: Tensor, width: int, height: int, tile_size: int) -> Tiles:
    """Sort the drawn Gaussians of each tile by depth, ties by index; boxes and depths are those of `Tables`."""
    across, down = -(-width // tile_size), -(-height // tile_size)
    n_cameras, n = depths.shape
    device = depths.device
    pixels = vectors(boxes)
    counts = torch.zeros(n_cameras * n, dtype=torch.int64, device=device)
    launch_ranges(tiles.count_tiles, len(counts), [pixels, tile_size, counts], like=counts)

    drawn = counts.nonzero().squeeze(1)
    order = drawn[torch.argsort(depths.view(-1)[drawn], stable=True)]
    ends = counts[order].cumsum(0)
    n_pairs = int(ends[-1]) if len(order) else 0
    check_pairs(n_pairs)
    pair_starts = torch.zeros_like(counts)
    pair_starts[order] = ends - counts[order]
    pair_tiles = torch.empty(n_pairs, dtype=torch.int32, device=device)
    pair_gaussians = torch.empty(n_pairs, dtype=torch.int32, device=device)
    inputs = [order, pair_starts, pixels, n, tile_size, across, down, pair_tiles, pair_gaussians]
    launch_ranges(tiles.emit_pairs, len(order), inputs, like=counts)
    sorted_tiles, pairs = torch.sort(pair_tiles, stable=True)
    every_tile = torch.arange(n_cameras * across * down + 1, dtype=torch.int32, device=device)
    starts = torch.searchsorted(sorted_tiles, every_tile)
    gaussians, pair_numbers = (opaque_buffer(n_pairs, dtype, device) for dtype in (torch.int32, torch.int64))
    torch.index_select(pair_gaussians, 0, pairs, out=opaque_elements(gaussians))
    opaque_elements(pair_numbers).copy_(pairs)
    return Tiles(tile_size, across, down, starts, gaussians, pair_numbers, pair_starts, counts)


def check_pairs(n_pairs: int) -> None:
    """Refuse more pairs than can be numbered."""
    if n_pairs > MAX_PAIRS:
        raise ValueError(
            f"tile_size: expected at most {MAX_PAIRS} pairs of a Gaussian and a tile, got {n_pairs}. "
            "Draw fewer or smaller Gaussians, a smaller image, or larger tiles."
        )


def even_work(starts: Tensor) -> list[int]:
    """Bounds of ranges of tiles with about equally many pairs; an empty tile counts a little too."""
    n_tiles = len(starts) - 1
    parts = min(RANGES_PER_THREAD * kernel_threads(), n_tiles)
    if n_tiles == 0 or starts.is_cuda or kernel_threads() == 1:
        return [0, n_tiles]
    work = starts + torch.arange(n_tiles + 1) * 4
    targets = torch.arange(1, parts) * int(work[-1]) // parts
    return [0, *torch.searchsorted(work, targets).tolist(), n_tiles]


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
