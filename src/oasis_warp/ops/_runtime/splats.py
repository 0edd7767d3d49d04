"""What every way of blending takes and gives: the strips of the CPU, the blocks of CUDA, the generic tiles."""

from typing import NamedTuple

from torch import Tensor

from oasis_warp.ops._runtime.records import Tables, table_words, tables


class Splats(NamedTuple):
    """What is drawn by C cameras, contiguous."""

    records: Tensor
    """Of the projection: see `_records`."""
    opacities: Tensor
    """[C, N]."""
    colors: Tensor
    """[C, N, D]."""
    backgrounds: Tensor
    """[C, D]."""

    def tables(self) -> Tables:
        """Where and how the Gaussians are drawn."""
        return tables(self.records, *self.opacities.shape, self.opacities.dtype)

    def words(self) -> dict[str, int]:
        """Addresses of the tables, by name."""
        return table_words(self.records, self.opacities.numel(), self.opacities.dtype)


class Frame(NamedTuple):
    """Size of the images and of the tiles that work is split into [px]."""

    width: int
    height: int
    tile_size: int


class Wanted(NamedTuple):
    """Which gradients are asked for."""

    shape: bool
    """Those by means2d, covars2d and opacities."""
    colors: bool
    backgrounds: bool


class Gradients(NamedTuple):
    """By what was drawn; what was not asked for is None."""

    means2d: Tensor | None
    covars2d: Tensor | None
    opacities: Tensor | None
    colors: Tensor | None
    backgrounds: Tensor | None
