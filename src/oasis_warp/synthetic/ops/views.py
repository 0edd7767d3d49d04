"""Float32 tensors as arguments of Warp kernels. The operators beside this file have no derivative."""

from typing import Any, NamedTuple

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.scene.sky import Lamps as LampArrays
from oasis_warp.ops._runtime.launch import view


def scalars(tensor: Tensor) -> Tensor:
    """An array of numbers."""
    return tensor.contiguous()


def integers(tensor: Tensor) -> Tensor:
    """An array of int32."""
    return tensor.to(torch.int32).contiguous()


def vectors(tensor: Tensor) -> Any:
    """An array of vectors along the last axis, which has 3."""
    return view(tensor.contiguous(), wp.vec3f)


def matrices(tensor: Tensor) -> Any:
    """An array of 4 x 4 matrices."""
    return view(tensor.contiguous(), wp.mat44f)


class Lamps(NamedTuple):
    """Round lamps, with the depth buffers that they see; L lamps an image. A black one is none."""

    positions: Float[Tensor, "B L 3"]
    colors: Float[Tensor, "B L 3"]
    """Irradiance over pi on a surface that faces the lamp at distance `ranges`, linear RGB."""
    ranges: Float[Tensor, "B L"]
    spreads: Float[Tensor, "B L"]
    """Radius over distance."""
    viewmats: Float[Tensor, "B L 4 4"]
    focals: Float[Tensor, "B L"]
    """Focal lengths of the depth buffers [px]; their axis is the middle."""
    depths: Float[Tensor, "B L M M"]

    def struct(self) -> Any:
        """All of these as one argument of a kernel."""
        out = LampArrays()
        out.positions, out.colors = vectors(self.positions), vectors(self.colors)
        out.ranges, out.spreads, out.focals = (view(t.contiguous()) for t in (self.ranges, self.spreads, self.focals))
        out.views, out.depths = matrices(self.viewmats), view(self.depths.flatten(0, 1).contiguous())
        return out
