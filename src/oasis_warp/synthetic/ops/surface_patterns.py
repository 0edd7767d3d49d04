"""Procedural patterns on points of a surface: gradient noise, lines and spots; and random numbers for pixels.

The numbers depend on one seed per image and nothing else.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import surface_patterns as kernels
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.launch import launch, launch_ranges
from oasis_warp.ops.checks import check_index, check_positive, check_shape
from oasis_warp.synthetic.ops.views import integers, scalars, vectors


class NoiseField(NamedTuple):
    """One field of `surface_noise`."""

    cell: float
    """Size of the largest cells, in the unit of the points."""
    seed: int
    octaves: int = 1
    """Each has half the size and half the strength of the one before."""


_NOISE = Declaration("surface_noise", inputs={"points": Array("N 3")}, public=False)


def surface_noise(points: Float[Tensor, "N 3"], fields: Sequence[NoiseField]) -> Float[Tensor, "K N"]:
    """Gradient noise (Perlin 2002) of each of `fields` at float32 `points`, about [-1, 1] an octave, no gradient.

    Raises:
        ValueError: a wrong shape, or a cell that is not positive.
    """
    _NOISE.check(points=points)
    for field in fields:
        check_positive("cell", field.cell)

    def column(values: list, dtype: torch.dtype) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=points.device)

    points, out = points.detach().float(), points.new_empty((len(fields), len(points)), dtype=torch.float32)
    inputs = [
        vectors(points), column([f.cell for f in fields], torch.float32), column([f.seed for f in fields], torch.int32),
        column([f.octaves for f in fields], torch.int32), out,
    ]  # fmt: skip
    launch_ranges(kernels.noise, len(points), inputs, like=points)
    return out


class PointGrid(NamedTuple):
    """Points of a surface, sorted into cells of space: what `surface_dabs` draws on. See `point_grid`."""

    points: Float[Tensor, "N 3"]
    """Those of one cell after those of another."""
    numbers: Int[Tensor, "N"]
    """int32: of the points, as they came."""
    starts: Int[Tensor, "C"]
    """int32: of each cell's points, the cells in rows along z, those in rows along y; one more at the end."""
    low: tuple[float, float, float]
    """Corner of the first cell."""
    cell: float
    size: tuple[int, int, int]
    """Cells along each axis."""

    def to(self, device: torch.device | str) -> "PointGrid":
        """The same grid on another device."""
        tensors = (self.points.to(device), self.numbers.to(device), self.starts.to(device))
        return PointGrid(*tensors, self.low, self.cell, self.size)


def point_grid(points: Float[Tensor, "N 3"], cell: float) -> PointGrid:
    """Sort one or more float32 points into cubes with edges of `cell`; finer ones serve narrower dabs.

    Raises:
        ValueError: a wrong shape, no point, or a cell that is not positive.
    """
    check_shape("points", points, "N", 3)
    check_positive("cell", cell)
    if not len(points):
        raise ValueError("points: expected one or more, got none.")
    low = points.amin(0)
    place = ((points - low) / cell).floor().to(torch.int64)
    size = [int(n) + 1 for n in place.amax(0)]
    row = (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]
    order = torch.argsort(row, stable=True)
    bounds = torch.arange(size[0] * size[1] * size[2] + 1, device=points.device)
    starts = torch.searchsorted(row[order], bounds)
    x, y, z = low.tolist()
    return PointGrid(
        points[order], order.to(torch.int32), starts.to(torch.int32), (x, y, z), cell, (size[0], size[1], size[2])
    )


_DABS = Declaration(
    "surface_dabs",
    inputs={"centers": Array("M 3"), "widths": Array("M"), "strengths": Array("M"), "kinds": Array("M", index="K")},
    public=False,
)


@torch.no_grad()
def surface_dabs(
    grid: PointGrid,
    centers: Float[Tensor, "M 3"],
    widths: Float[Tensor, "M"],
    strengths: Float[Tensor, "M"],
    kinds: Int[Tensor, "M"],
    n_kinds: int,
    *,
    flat: bool = False,
) -> Float[Tensor, "K N"]:
    """At each point of a surface the strongest dab of each kind: the largest s exp(-(d / w)^2), 0 where none is near.

    Dabs closer together than they are wide make a line. No gradient.

    Args:
        grid: The surface; the points of the result are in the order in which `point_grid` got them.
        centers: float32 [M, 3]; M may be 0.
        widths: Widths of the profile, in the unit of the points, [M]; beyond sqrt(8) of them a dab ends.
        strengths: Values at the centres, [M]; up to 0 nothing is drawn.
        kinds: Row of the result that each dab counts for, [M].
        n_kinds: Number of rows.
        flat: The profile is exp(-(d / w)^4), a spot with an even middle.

    Raises:
        ValueError: wrong shapes, or a kind that has no row.
    """
    _DABS.check(centers=centers, widths=widths, strengths=strengths, kinds=kinds)
    check_index("kinds", kinds, n_kinds, "kinds")
    points, numbers, starts, low, cell, size = grid
    out = points.new_zeros((n_kinds, len(points)))
    inputs = [
        vectors(centers.float()), scalars(widths.float()), scalars(strengths.float()), integers(kinds), flat,
        vectors(points), numbers, starts, wp.vec3f(*low), cell, wp.vec3i(*size), out,
    ]  # fmt: skip
    launch(kernels.dabs, len(centers), inputs, like=points)
    return out


def pixel_noise(seeds: Int[Tensor, "B"], *shape: int) -> Float[Tensor, "B ..."]:
    """Standard normal float32 numbers of `shape` for each of the seeds, equal on all devices up to rounding.

    Raises:
        ValueError: `seeds` is not a row.
    """
    check_shape("seeds", seeds, "B")
    n = math.prod(shape)
    out = torch.empty((len(seeds), n), device=seeds.device)
    launch_ranges(kernels.normal, out.numel(), [integers(seeds), n, out], like=out)
    return out.unflatten(1, shape)
