"""Lines on the skin: collected one by one with the random numbers of each, then drawn all at once on any device."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.ops.surface_patterns import PointGrid, surface_dabs

KINDS = ("crease", "main", "minor", "fold", "wrinkle", "vein", "tendon", "hair", "halo")
"""Flexion creases of the fingers and wrist; the palm's main and its fine lines; folds over the knuckles; compression
wrinkles; vessels; tendons; hairs; the soft valley along main lines."""
_LONG = ("crease", "main", "halo")
_SPACING = 0.25
"""Between samples of one line, and of hairs [mm]."""
_HAIR_SPACING = 0.14
_PLACE_CELL, _STRENGTH_CELL = 5.0, 4.0
"""Distances between the values that a line's place and width, and its strength, wander through [mm]."""
_WALKS = 5
"""Of one line: three of its place, one of its strength, one of its width."""
_FAINT = 1e-3
"""Strength up to which nothing is drawn."""


class _Line(NamedTuple):
    """Numbers of one line."""

    corners: int
    length: float
    width: float
    strength: float
    taper: float
    wobble: float
    kind: int
    place_knots: int
    """Random values of each walk but that of the strength."""
    strength_knots: int


class Strokes:
    """A growing collection of lines; lengths in millimetres."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self._lines: list[_Line] = []
        self._corners: list[np.ndarray] = []  # x, y, z, distance from the line's start
        self._knots: list[np.ndarray] = []

    def add(self, kind: str, points: np.ndarray, width: float, strength: float, *, taper: float = 0.25,
            wobble: float = 0.3) -> None:  # fmt: skip
        """Draw a line through `points` [n, 3].

        Args:
            kind: One of `KINDS`.
            points: On the surface, in order.
            width: Of the Gaussian profile.
            strength: In the middle; it wanders by up to a quarter, that of fine lines by twice as much.
            taper: Share of the length over which either end fades.
            wobble: Amplitude of the line's own wander.
        """
        steps = points[1:] - points[:-1]
        corners = np.empty((len(points), 4))
        corners[:, :3] = points
        corners[0, 3] = 0
        np.cumsum(np.sqrt((steps * steps).sum(1)), out=corners[1:, 3])
        length = float(corners[-1, 3])
        if length < 1e-6:
            return
        place_knots, strength_knots = (int(np.ceil(length / cell + 3)) for cell in (_PLACE_CELL, _STRENGTH_CELL))
        self._knots.append(self.rng.uniform(-1, 1, (_WALKS - 1) * place_knots + strength_knots))
        self._corners.append(corners)
        self._lines.append(
            _Line(len(points), length, width, strength, taper, wobble, KINDS.index(kind), place_knots, strength_knots)
        )

    def draw(self, grid: PointGrid) -> dict[str, Float[Tensor, "N"]]:
        """The profile of each kind at the points of a surface: the strongest line near by."""
        device = grid.points.device
        if not self._lines:
            return dict(zip(KINDS, torch.zeros(len(KINDS), len(grid.points), device=device), strict=True))
        table = np.array(self._lines)
        line = dict(zip(_Line._fields, table.T, strict=True))
        spacing = np.where(line["kind"] == KINDS.index("hair"), _HAIR_SPACING, _SPACING)
        counts = np.maximum(4, (line["length"] / spacing).astype(np.int64))
        before = lambda n: np.cumsum(n) - n  # noqa: E731
        knots = (_WALKS - 1) * line["place_knots"] + line["strength_knots"]
        firsts = np.stack([before(counts), before(line["corners"]), before(line["length"] + 1.0), before(knots)])
        loud = np.where(np.isin(line["kind"], [KINDS.index(k) for k in _LONG]), 0.25, 0.5)
        rows = np.concatenate([table, counts[:, None], firsts.T, loud[:, None]], 1)
        # One copy to the device for everything.
        sizes = rows.size, 4 * int(line["corners"].sum()), int(knots.sum())
        packed = np.concatenate([rows.ravel(), *(c.ravel() for c in self._corners), *self._knots])
        rows_there, corners, knots_there = torch.from_numpy(packed).to(device).split(sizes)
        samples = _sampled(rows_there.view(rows.shape), corners.view(-1, 4), knots_there, int(counts.sum()))
        return dict(zip(KINDS, surface_dabs(grid, *samples, len(KINDS)).unbind(0), strict=True))


class _Samples(NamedTuple):
    centers: Tensor
    widths: Tensor
    strengths: Tensor
    kinds: Tensor


def _sampled(lines: Tensor, corners: Tensor, knots: Tensor, total: int) -> _Samples:
    """Points along all lines, evenly spaced on each.

    Args:
        lines: For each line the fields of `_Line`, the number of its samples, the sum over the lines before it of
            samples, corners, lengths + 1 and knots, and by how much its strength wanders; float64 [L, 15].
        corners: x, y, z and distance from the start, [C, 4].
        knots: Of the lines' walks, one after the other.
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

    wander = torch.stack([walk(_PLACE_CELL, first_knot + k * place_knots) for k in range(3)], 1)
    strength_knot = first_knot + 3 * place_knots
    fade = (torch.minimum(u, 1 - u) / taper).clamp(0, 1) ** 0.7
    strengths = strength * fade * (1 + loud * walk(_STRENGTH_CELL, strength_knot))
    return _Samples(
        (places + wobble[:, None] * wander).float(),
        (width * (1 + 0.2 * walk(_PLACE_CELL, strength_knot + lines[of, 8]))).float(),
        torch.where(strengths > _FAINT, strengths, 0.0).float(),
        kind.int(),
    )


def through(controls: np.ndarray, n: int = 40) -> np.ndarray:
    """A smooth curve of n points through 2 to 4 control points (polynomial)."""
    controls = np.asarray(controls, float)
    k, t = np.linspace(0, 1, len(controls)), np.linspace(0, 1, n)
    powers = np.polyfit(k, controls, min(3, len(controls) - 1))
    return np.stack([np.polyval(powers[:, j], t) for j in range(controls.shape[1])], 1)
