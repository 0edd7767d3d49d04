"""The weights of `blend_weights` with the generic kernel: on CUDA, and in float64 on the CPU."""

from typing import NamedTuple

import torch
from torch import Tensor
from warp import vec4i

from oasis_kernels.rasterize import rasterize_weights as kernels
from oasis_warp.ops._runtime.blend_tiles import CUDA_LANES, lane_grid
from oasis_warp.ops._runtime.launch import SCALAR, VEC4, launch_ranges, view
from oasis_warp.ops._runtime.registration import revealed
from oasis_warp.ops._runtime.rules import current_rules
from oasis_warp.ops._runtime.splats import Splats
from oasis_warp.ops._runtime.tiles import bin_to_tiles, even_work

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
    """Weight alpha T of every Gaussian in every pixel, for one camera. Colours and backgrounds are not read.

    Raises:
        ValueError: more weights than int32 can count.
    """
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
                view(tiles.starts), view(revealed(tiles.gaussians)), view(records.boxes.view(-1, 4), vec4i),
                view(records.centers.view(-1, 4), VEC4[dtype]), view(records.whitenings.view(-1, 4), VEC4[dtype]),
                view(splats.opacities.view(-1)), tiles.size, lane_width, lane_height, tiles.across, tiles.down, width,
                height, int(write), view(starts), view(scratch), view(counts), view(columns), view(values),
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
