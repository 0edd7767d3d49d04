"""What every way of blending takes and gives: the strips of the CPU, the blocks of CUDA, the generic tiles."""

from typing import NamedTuple

from torch import Tensor


class Splats(NamedTuple):
    """What is drawn, as the projection made it: see `Projection`. M = cameras * Gaussians."""

    depths: Tensor
    centers: Tensor
    whitenings: Tensor
    boxes: Tensor
    opacities: Tensor
    colors: Tensor
    backgrounds: Tensor


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
