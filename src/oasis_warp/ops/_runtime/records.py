"""Results of the projection for the blending, in one allocation, because each torch tensor costs time.

Four tables with a row for each (camera, Gaussian), one after the other, and for the CUDA rasterizer the counters of its
tiles, which are zero between calls.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_kernels.rasterize.tiles_cuda import COUNTERS, TILE, spread_of
from oasis_warp.ops._runtime.launch import has_cuda_kernels

Size = int | torch.SymInt
"""A size, which is not known yet where torch traces."""


class Tables(NamedTuple):
    """Views of records."""

    centers: Tensor
    """Whole x, whole y, remainder x, remainder y of a Gaussian's place in the image [px], [C, N, 4]."""
    whitenings: Tensor
    """Rows of W with W^T W the inverse covariance, [C, N, 4]."""
    boxes: Tensor
    """Pixels x0, y0, x1, y1 (past the end) that it can reach, [C, N, 4]; int32."""
    sort_depths: Tensor
    """Camera z as computed, to sort by, [C, N]; float64."""


def _starts(total: Size, dtype: torch.dtype) -> tuple[Size, Size, Size, Size, Size]:
    """First byte of each table for `total` rows, and of what follows them."""
    row = 4 * dtype.itemsize
    return 0, row * total, 2 * row * total, (2 * row + 16) * total, (2 * row + 24) * total


def counters_size(like: Tensor, n_cameras: Size, width: Size, height: Size) -> Size:
    """Bytes of the counters that follow the tables for images by Gaussians like these."""
    n_tiles = n_cameras * -(-width // TILE) * -(-height // TILE)
    return 8 * COUNTERS + 4 * n_tiles * spread_of(n_tiles) if has_cuda_kernels(like) else 0


def empty_records(like: Tensor, n_cameras: Size, n: Size, width: Size, height: Size) -> Tensor:
    """Memory [bytes], uint8, for Gaussians like these."""
    size = _starts(n_cameras * n, like.dtype)[-1] + counters_size(like, n_cameras, width, height)
    return torch.empty(size, dtype=torch.uint8, device=like.device)


def tables(records: Tensor, n_cameras: Size, n: Size, dtype: torch.dtype) -> Tables:
    """The tables as tensors, for Gaussians of this precision."""
    cuts = _starts(n_cameras * n, dtype)

    def table(k: int, kind: torch.dtype, *size: int) -> Tensor:
        return records[cuts[k] : cuts[k + 1]].view(kind).view(n_cameras, n, *size)

    return Tables(table(0, dtype, 4), table(1, dtype, 4), table(2, torch.int32, 4), table(3, torch.float64))


def records_of_camera(records: Tensor, camera: int, n_cameras: int, n: int, dtype: torch.dtype) -> Tensor:
    """The tables of one camera, as records of their own; without counters."""
    parts = tables(records, n_cameras, n, dtype)
    return torch.cat([table[camera].contiguous().view(torch.uint8).flatten() for table in parts])


def table_params(records: Tensor, total: int, dtype: torch.dtype) -> dict[str, Any]:
    """Addresses of the tables by name and of the `counters`, for kernels that take raw pointers."""
    first, (centers, whitenings, boxes, depths, counters) = records.data_ptr(), _starts(total, dtype)
    return {
        "centers": first + centers,
        "whitenings": first + whitenings,
        "boxes": first + boxes,
        "sort_depths": first + depths,
        "counters": first + counters,
    }


class Splats(NamedTuple):
    """Projected Gaussians of C cameras, contiguous."""

    records: Tensor
    """Records of the projection."""
    opacities: Tensor
    """[C, N]."""
    colors: Tensor
    """[C, N, D]."""
    backgrounds: Tensor
    """[C, D]."""

    def tables(self) -> Tables:
        """Where and how the Gaussians are drawn."""
        return tables(self.records, *self.opacities.shape, self.opacities.dtype)

    def params(self) -> dict[str, Any]:
        """Parameters of the float32 kernels: the tables and these."""
        return {**table_params(self.records, self.opacities.numel(), self.opacities.dtype), **self._asdict()}


class Frame(NamedTuple):
    """Size of the images and of the tiles that work is split into [px]."""

    width: int
    height: int
    tile_size: int


class GradientFlags(NamedTuple):
    """Which gradients of blending are needed."""

    shape: bool
    """Gradients by means2d, covars2d and opacities."""
    colors: bool
    backgrounds: bool


class Gradients(NamedTuple):
    """Gradients of blending; None where they are not needed."""

    means2d: Tensor | None
    covars2d: Tensor | None
    opacities: Tensor | None
    colors: Tensor | None
    backgrounds: Tensor | None
