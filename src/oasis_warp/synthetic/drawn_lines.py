"""Lines drawn on the points of a surface, all at once on any device."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.ops.surface_patterns import PointGrid, surface_dabs
from oasis_warp.synthetic.strokes import CORNER_WORDS, KINDS, LINE_WORDS, PLACE_CELL, STRENGTH_CELL, Lines

_FAINT = 1e-3
"""Strength up to which nothing is drawn."""


def draw_lines(lines: Lines, grid: PointGrid) -> dict[str, Float[Tensor, "N"]]:
    """The profile of each kind at the points of a surface [mm]: the strongest line near by."""
    numbers = torch.from_numpy(lines.numbers).to(grid.points.device)
    first_corner = lines.n_lines * LINE_WORDS
    first_knot = first_corner + lines.n_corners * CORNER_WORDS
    rows, corners = numbers[:first_corner].view(-1, LINE_WORDS), numbers[first_corner:first_knot]
    samples = _sampled(rows, corners.view(-1, CORNER_WORDS), numbers[first_knot:], lines.n_samples)
    return dict(zip(KINDS, surface_dabs(grid, *samples, len(KINDS)).unbind(0), strict=True))


class _Samples(NamedTuple):
    centers: Tensor
    widths: Tensor
    strengths: Tensor
    kinds: Tensor


def _sampled(lines: Tensor, corners: Tensor, knots: Tensor, total: int) -> _Samples:
    """Points along all lines, evenly spaced on each.

    Args:
        lines: [L, 15], the first of `Lines.numbers`.
        corners: [C, 4], those after them.
        knots: The last ones.
        total: Number of samples.
    """
    device = lines.device
    of = torch.repeat_interleave(torch.arange(len(lines), device=device), lines[:, 9].long(), output_size=total)
    n_corners, length, width, strength, taper, wobble, kind, place_knots, _, count, first, first_corner, shift, \
        first_knot, loud = lines[of].unbind(1)  # fmt: skip
    u = (torch.arange(total, device=device) - first) / (count - 1)
    t = u * length

    # All lines laid end to end, with gaps, are one: one search finds the corners that each sample lies between.
    whole = torch.repeat_interleave(
        torch.arange(len(lines), device=device), lines[:, 0].long(), output_size=len(corners)
    )
    along = corners[:, 3].contiguous()
    corner = torch.searchsorted(along + lines[whole, 12], t + shift, right=True) - 1
    corner = torch.minimum(torch.maximum(corner, first_corner.long()), (first_corner + n_corners).long() - 2)
    share = ((t - along[corner]) / (along[corner + 1] - along[corner]).clamp_min(1e-12)).clamp(0, 1)
    start, end = corners[corner, :3], corners[corner + 1, :3]
    places = start + share[:, None] * (end - start)

    def walk(cell: float, first: Tensor) -> Tensor:
        step = t / cell
        low = step.floor()
        index = (first + 1 + low).long()  # the first knot lies one cell before the line
        return knots[index] + (step - low) * (knots[index + 1] - knots[index])

    wander = torch.stack([walk(PLACE_CELL, first_knot + k * place_knots) for k in range(3)], 1)
    strength_knot = first_knot + 3 * place_knots
    fade = (torch.minimum(u, 1 - u) / taper).clamp(0, 1) ** 0.7
    strengths = strength * fade * (1 + loud * walk(STRENGTH_CELL, strength_knot))
    return _Samples(
        (places + wobble[:, None] * wander).float(),
        (width * (1 + 0.2 * walk(PLACE_CELL, strength_knot + lines[of, 8]))).float(),
        torch.where(strengths > _FAINT, strengths, 0.0).float(),
        kind.int(),
    )
