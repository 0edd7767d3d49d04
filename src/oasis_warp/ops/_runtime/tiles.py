"""Lists of Gaussians for the tiles of the images."""

from typing import NamedTuple

import torch
from jaxtyping import Int32, Int64
from torch import Tensor

from oasis_kernels.rasterize import tiles
from oasis_warp.core.processes import kernel_threads
from oasis_warp.ops._runtime.launch import launch_ranges, vectors

MAX_PAIRS = 2**31 - 1
"""Pairs of a Gaussian and a tile that one call can hold."""
RANGES_PER_THREAD = 4
"""Ranges of tiles per thread, so that none waits long for the last."""


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
