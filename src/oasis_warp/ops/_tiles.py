"""Lists of Gaussians for the tiles of the images."""

from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float64, Int32, Int64
from torch import Tensor

from oasis_kernels import tiles
from oasis_warp.ops._launch import even_cuts, launch_ranges, view
from oasis_warp.ops.projection import Projection

MAX_PAIRS = 2**31 - 1
"""Pairs of a Gaussian and a tile that one call can hold."""
RANGES_A_THREAD = 4
"""Ranges of tiles a thread, so that none waits long for the last."""


class Tiles(NamedTuple):
    """Which Gaussians each tile draws, front to back. P pairs of a Gaussian and a tile."""

    size: int
    """Side of a tile [px]."""
    across: int
    down: int
    starts: Int64[Tensor, "tiles_plus_one"]
    """First place of each tile, camera by camera, row by row; at the end P."""
    gaussians: Int32[Tensor, "P"]
    """camera * N + gaussian at each place."""
    pairs: Int64[Tensor, "P"]
    """Number of the pair at each place; a Gaussian's pairs have consecutive numbers."""
    pair_starts: Int64[Tensor, "M"]
    """First number of each Gaussian's pairs, by camera * N + gaussian."""
    pair_counts: Int64[Tensor, "M"]
    cuts: list[int]
    """Bounds of ranges of tiles of about equal work, for `launch_ranges`."""


def bin_to_tiles(projection_: Projection, width: int, height: int, tile_size: int) -> Tiles:
    """Sort the drawn Gaussians of each tile by depth, ties by index.

    Raises:
        ValueError: more than `MAX_PAIRS` pairs.
    """
    n_cameras, n = projection_.depths.shape
    across, down = -(-width // tile_size), -(-height // tile_size)
    n_tiles = n_cameras * across * down
    device = projection_.depths.device
    boxes = view(projection_.boxes.view(-1, 4), wp.vec4i)
    counts = torch.zeros(n_cameras * n, dtype=torch.int64, device=device)
    launch_ranges(tiles.count_tiles, even_cuts(len(counts)), [boxes, tile_size, view(counts)], like=counts)

    drawn = counts.nonzero().squeeze(1)
    order = drawn[argsort_positive(projection_.sort_depths.view(-1)[drawn])]
    ends = counts[order].cumsum(0)
    n_pairs = int(ends[-1]) if len(order) else 0
    if n_pairs > MAX_PAIRS:
        raise ValueError(
            f"tile_size: expected at most {MAX_PAIRS} pairs of a Gaussian and a tile, got {n_pairs}. "
            "Draw fewer or smaller Gaussians, a smaller image, or larger tiles."
        )
    pair_starts = torch.zeros_like(counts)
    pair_starts[order] = ends - counts[order]
    pair_tiles = torch.empty(n_pairs, dtype=torch.int32, device=device)
    pair_gaussians = torch.empty(n_pairs, dtype=torch.int32, device=device)
    launch_ranges(
        tiles.emit_pairs,
        even_cuts(len(order)),
        [view(order), view(pair_starts), boxes, n, tile_size, across, down, view(pair_tiles), view(pair_gaussians)],
        like=counts,
    )
    sorted_tiles, pairs = torch.sort(pair_tiles, stable=True)
    starts = torch.searchsorted(sorted_tiles, torch.arange(n_tiles + 1, dtype=torch.int32, device=device))
    return Tiles(
        tile_size, across, down, starts, pair_gaussians[pairs], pairs, pair_starts, counts, _even_work(starts)
    )


def argsort_positive(keys: Float64[Tensor, "K"]) -> Int64[Tensor, "K"]:
    """Stable order of positive float64 `keys`, whose bits sort as integers do."""
    n = len(keys)
    if keys.is_cuda or n == 0:
        return torch.argsort(keys, stable=True)
    bits = torch.empty(2 * n, dtype=torch.int64)  # the second half is the sort's own
    order = torch.empty(2 * n, dtype=torch.int32)
    bits[:n] = keys.view(torch.int64)
    torch.arange(n, out=order[:n])
    wp.utils.radix_sort_pairs(view(bits), view(order), n)  # half the time of torch's sort
    return order[:n].long()


def _even_work(starts: Tensor) -> list[int]:
    """Bounds of ranges of tiles with about as many pairs each; a tile counts a little even when it is empty."""
    n_tiles = len(starts) - 1
    parts = min(RANGES_A_THREAD * torch.get_num_threads(), n_tiles)
    if starts.is_cuda or torch.get_num_threads() == 1:
        return [0, n_tiles]
    work = starts + torch.arange(n_tiles + 1) * 4
    wanted = torch.arange(1, parts) * int(work[-1]) // parts
    return [0, *torch.searchsorted(work, wanted).tolist(), n_tiles]
