"""Procedural patterns on points of a surface: gradient noise and lines."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels import surface_patterns as kernels
from oasis_warp.core.checks import check_positive, check_shape
from oasis_warp.ops._launch import even_cuts, launch_ranges, view
from oasis_warp.ops._registration import operator

REACH = 8.0**0.5
"""Widths beyond which a line is nothing: the kernel's own bound."""


class NoiseField(NamedTuple):
    """One field of `surface_noise`."""

    cell: float
    """Size of the largest cells, in the unit of the points."""
    seed: int
    octaves: int = 1
    """Each has half the size and half the strength of the one before."""


def _noise(points: Tensor, cells: Tensor, seeds: Tensor, octaves: Tensor) -> Tensor:
    out = points.new_empty((len(points), len(cells)))
    inputs = [view(points.contiguous(), wp.vec3f), view(cells), view(seeds), view(octaves), view(out)]
    launch_ranges(kernels.noise, even_cuts(len(points)), inputs, like=points)
    return out


def _noise_fake(points: Tensor, cells: Tensor, seeds: Tensor, octaves: Tensor) -> Tensor:
    return points.new_empty((len(points), len(cells)))


_noise_op = operator("surface_noise", _noise, _noise_fake)


def surface_noise(points: Float[Tensor, "N 3"], fields: Sequence[NoiseField]) -> Float[Tensor, "N K"]:
    """Gradient noise (Perlin 2002) of each of `fields` at float32 `points`, about [-1, 1] an octave, no gradient.

    Raises:
        ValueError: a wrong shape, or a cell that is not positive.
    """
    check_shape("points", points, "N", 3)
    for field in fields:
        check_positive("cell", field.cell)

    def column(values: list, dtype: torch.dtype) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=points.device)

    return _noise_op(
        points.detach().float(),
        column([f.cell for f in fields], torch.float32),
        column([f.seed for f in fields], torch.int32),
        column([f.octaves for f in fields], torch.int32),
    )


def _lines(
    points: Tensor, samples: Tensor, widths: Tensor, strengths: Tensor, kinds: Tensor, n_kinds: int, cell: float
) -> Tensor:
    out = points.new_zeros((len(points), n_kinds))
    if not len(samples):
        return out
    low = samples.amin(0)
    size = [int(n) + 1 for n in ((samples.amax(0) - low) / cell).floor().tolist()]
    place = ((samples - low) / cell).floor().to(torch.int64)
    row = (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]
    order = torch.argsort(row, stable=True)
    bounds = torch.arange(size[0] * size[1] * size[2] + 1, device=points.device)
    starts = torch.searchsorted(row[order], bounds).to(torch.int32)
    inputs = [
        view(points.contiguous(), wp.vec3f), view(samples[order].contiguous(), wp.vec3f),
        *(view(t[order].contiguous()) for t in (widths, strengths, kinds)), view(starts),
        wp.vec3f(*low.tolist()), cell, wp.vec3i(*size), view(out),
    ]  # fmt: skip
    launch_ranges(kernels.lines, even_cuts(len(points)), inputs, like=points)
    return out


def _lines_fake(points, samples, widths, strengths, kinds, n_kinds, cell):
    return points.new_empty((len(points), n_kinds))


_lines_op = operator("surface_lines", _lines, _lines_fake)


def surface_lines(
    points: Float[Tensor, "N 3"],
    samples: Float[Tensor, "M 3"],
    widths: Float[Tensor, "M"],
    strengths: Float[Tensor, "M"],
    kinds: Int[Tensor, "M"],
    n_kinds: int,
) -> Float[Tensor, "N K"]:
    """Profiles of lines, given as rows of samples: for each kind the largest s exp(-(d / w)^2), 0 where none is near.

    Args:
        points: Where to evaluate, float32 [N, 3].
        samples: Points of all lines, closer together than they are wide, [M, 3]; M may be 0.
        widths: Of the Gaussian profile at each sample, in the unit of the points, [M]; all are of one order, because
            the widest sets the size of the search cells.
        strengths: Values on the line, >= 0, [M].
        kinds: int32 column of the result that each sample counts for, [M].
        n_kinds: Number of columns.

    Raises:
        ValueError: wrong shapes, or a width that is not positive.
    """
    sizes: dict[str, int] = {}
    check_shape("points", points, "N", 3)
    check_shape("samples", samples, "M", 3, sizes=sizes)
    for name, tensor in (("widths", widths), ("strengths", strengths), ("kinds", kinds)):
        check_shape(name, tensor, "M", sizes=sizes)
    widest = 1.0
    if len(widths):
        check_positive("widths", float(widths.min()))
        widest = float(widths.max())
    return _lines_op(points, samples, widths, strengths, kinds.to(torch.int32), n_kinds, REACH * widest)
