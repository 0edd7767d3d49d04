"""Backends of `blend_weights`: vector kernels for float32 on the CPU, the generic kernel for all else."""

from typing import NamedTuple

import torch
from torch import Tensor

from oasis_kernels.rasterize import rasterize_forward as kernels
from oasis_kernels.rasterize import strips
from oasis_warp.ops._runtime.blend_strips import count, cut_strips
from oasis_warp.ops._runtime.blend_tiles import (
    CUDA_LANES,
    bin_to_tiles,
    even_work,
    lane_grid,
    opaque_elements,
    splat_views,
)
from oasis_warp.ops._runtime.launch import SCALAR, has_vectors, launch_ranges, phase_state, run_native
from oasis_warp.ops._runtime.records import Splats
from oasis_warp.ops._runtime.rules import current_rules

MAX_WEIGHTS = 2**31 - 1


class SparseWeights(NamedTuple):
    """Weights as rows of pixels, and of Gaussians: where rows start, indices, values; int32 and sorted."""

    pixel_starts: Tensor
    gaussians: Tensor
    by_pixel: Tensor
    gaussian_starts: Tensor
    pixels: Tensor
    by_gaussian: Tensor
    alphas: Tensor
    """[H * W]: sums of the pixels' weights."""


def check_weights(n_weights: int) -> None:
    """Refuse more weights than int32 can count."""
    if n_weights > MAX_WEIGHTS:
        raise ValueError(f"width: expected at most {MAX_WEIGHTS} weights, got {n_weights}. Draw a smaller image.")


def weigh(splats: Splats, width: int, height: int, tile_size: int) -> SparseWeights:
    """Weight alpha T of every Gaussian in every pixel, for one camera. Colours and backgrounds are not read."""
    weigh_by = weigh_strips if has_vectors(splats.opacities) else weigh_tiles
    return weigh_by(splats, width, height, tile_size)


def weigh_tiles(splats: Splats, width: int, height: int, tile_size: int) -> SparseWeights:
    """`weigh` by the generic kernel."""
    n, n_pixels, records = splats.opacities.shape[1], width * height, splats.tables()
    dtype, device = splats.opacities.dtype, splats.opacities.device
    tiles = bin_to_tiles(records.boxes, records.sort_depths, width, height, tile_size)
    scratch = torch.empty(n_pixels, dtype=dtype, device=device)
    counts = torch.empty(n_pixels, dtype=torch.int32, device=device)
    lanes, lane_width, lane_height = lane_grid(tile_size, device, CUDA_LANES)

    def run(write: bool, starts: Tensor, columns: Tensor, values: Tensor) -> None:
        launch_ranges(
            kernels.weigh(SCALAR[dtype], current_rules()),
            even_work(tiles.starts),
            [
                tiles.starts, opaque_elements(tiles.gaussians), *splat_views(splats), tiles.size, lane_width,
                lane_height, tiles.across, tiles.down, width, height, int(write), starts, scratch, counts, columns,
                values,
            ],
            like=scratch,
            lanes=lanes,
        )  # fmt: skip

    starts = torch.zeros(n_pixels + 1, dtype=torch.int64, device=device)
    columns, values = torch.empty(0, dtype=torch.int32, device=device), torch.empty(0, dtype=dtype, device=device)
    run(False, starts, columns, values)
    starts[1:] = counts.cumsum(0)
    n_weights = int(starts[-1])
    check_weights(n_weights)
    columns, values = columns.new_empty(n_weights), values.new_empty(n_weights)
    run(True, starts, columns, values)

    # Sorting by column, and then by row again, sorts within the rows: both sorts are stable.
    rows = torch.repeat_interleave(torch.arange(n_pixels, dtype=torch.int32, device=device), counts)
    columns, by_gaussian = torch.sort(columns, stable=True)
    rows, values = rows[by_gaussian], values[by_gaussian]
    pixels, by_pixel = torch.sort(rows, stable=True)
    of_pixels = values[by_pixel]
    alphas = torch.segment_reduce(of_pixels, "sum", offsets=starts, initial=0)
    return SparseWeights(
        _row_starts(pixels, n_pixels), columns[by_pixel], of_pixels, _row_starts(columns, n), rows, values, alphas
    )


def _row_starts(rows: Tensor, n: int) -> Tensor:
    every = torch.arange(n + 1, dtype=torch.int32, device=rows.device)
    return torch.searchsorted(rows, every, out_int32=True)


def weigh_strips(splats: Splats, width: int, height: int, tile_size: int) -> SparseWeights:
    """`weigh` by the vector kernels."""
    n, n_pixels = splats.opacities.shape[1], width * height
    s = cut_strips(1, n, width, height, tile_size, tiles_across=-(-width // tile_size))
    assert s.across == 1
    counted = count(splats, s)
    n_pairs = counted.n_pairs
    pair_weights = torch.empty(n_pairs, dtype=torch.int32)
    pixel_weights = torch.empty(n_pixels, dtype=torch.int32)
    params = counted.params | {
        "state": phase_state(strips.STATE), "entries": torch.empty(2 * n_pairs, dtype=torch.int64),
        "ids": opaque_elements(counted.lists.ids), "members": torch.empty(n_pairs, dtype=torch.int32),
        "pair_weights": pair_weights, "pixel_weights": pixel_weights,
    }  # fmt: skip
    n_tasks = max(s.n_chunks, s.n_strips)
    run_native(strips.count_weights(current_rules()), params, n_tasks)

    pair_places = _starts(pair_weights)
    n_weights = int(pair_places[-1])
    check_weights(n_weights)
    pixel_starts = _starts(pixel_weights).to(torch.int32)
    pixels, gaussians = (torch.empty(n_weights, dtype=torch.int32) for _ in range(2))
    by_gaussian, by_pixel, alphas = torch.empty(n_weights), torch.empty(n_weights), torch.empty(n_pixels)
    params |= {
        "state": phase_state(strips.STATE), "pair_places": pair_places,
        "pixel_places": pixel_starts[:-1].clone(), "gaussian_pixels": pixels, "gaussian_weights": by_gaussian,
        "pixel_gaussians": gaussians, "pixel_values": by_pixel, "alphas": alphas,
    }  # fmt: skip
    run_native(strips.fill_weights(current_rules()), params, n_tasks)
    # A Gaussian without pairs starts where the next one does.
    starts = pair_places[torch.cat([counted.lists.pair_starts.long(), torch.tensor([n_pairs])])]
    return SparseWeights(pixel_starts, gaussians, by_pixel, starts.to(torch.int32), pixels, by_gaussian, alphas)


def _starts(counts: Tensor) -> Tensor:
    """Where each of consecutive parts begins, and at the end the sum of all."""
    starts = torch.zeros(len(counts) + 1, dtype=torch.int64)
    torch.cumsum(counts, 0, out=starts[1:])
    return starts
