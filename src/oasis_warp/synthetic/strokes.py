"""Collect lines on the skin with their random numbers; `texels.draw_lines` draws them all at once.

This module needs no device, so that processes that plan people can import it.
"""

from typing import NamedTuple

import numpy as np

KINDS = ("crease", "main", "minor", "fold", "wrinkle", "vein", "tendon", "hair", "halo")
"""Flexion creases of the fingers and wrist; the palm's main and its fine lines; folds over the knuckles; compression
wrinkles; vessels; tendons; hairs; the soft valley along main lines."""
_LONG = ("crease", "main", "halo")
_SPACING = 0.25
_HAIR_SPACING = 0.14
"""Distance between the samples of a line, and of a hair [mm]."""
PLACE_CELL, STRENGTH_CELL = 5.0, 4.0
"""Distance between the random values of a line's position and width, and of its strength [mm]."""
_WALKS = 5
"""Random walks of one line: three of its position, one of its strength, one of its width."""
LINE_WORDS, CORNER_WORDS = 15, 4
"""Numbers in `Lines` for each line and for each of its corners."""


class Lines(NamedTuple):
    """Lines in one array, which is copied to the device at once."""

    numbers: np.ndarray
    """float64. First `n_lines` rows: the fields of `_Line`, the number of samples, the sums over all lines before of
    samples, corners, lengths + 1 and knots, and the amplitude of the strength's walk. Then `n_corners` rows: x, y, z,
    distance from the line's start. Then the knots of the random walks, line after line."""
    n_lines: int
    n_corners: int
    n_samples: int


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
    """Random values of each walk except the strength's."""
    strength_knots: int


class Strokes:
    """A collection of lines; lengths in millimetres."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self._lines: list[_Line] = []
        self._corners: list[np.ndarray] = []
        self._knots: list[np.ndarray] = []

    def add(self, kind: str, points: np.ndarray, width: float, strength: float, *, taper: float = 0.25,
            wobble: float = 0.3) -> None:  # fmt: skip
        """Add a line through `points` [n, 3].

        Args:
            kind: One of `KINDS`.
            points: On the surface, in order.
            width: Width of the Gaussian profile.
            strength: Strength in the middle; it varies by up to a quarter, that of fine lines by up to a half.
            taper: Share of the length over which each end fades.
            wobble: Amplitude of the random walk of the position.
        """
        steps = points[1:] - points[:-1]
        corners = np.empty((len(points), CORNER_WORDS))
        corners[:, :3] = points
        corners[0, 3] = 0
        np.cumsum(np.sqrt((steps * steps).sum(1)), out=corners[1:, 3])
        length = float(corners[-1, 3])
        if length < 1e-6:
            return
        place_knots, strength_knots = (int(np.ceil(length / cell + 3)) for cell in (PLACE_CELL, STRENGTH_CELL))
        self._knots.append(self.rng.uniform(-1, 1, (_WALKS - 1) * place_knots + strength_knots))
        self._corners.append(corners)
        self._lines.append(
            _Line(len(points), length, width, strength, taper, wobble, KINDS.index(kind), place_knots, strength_knots)
        )

    def lines(self) -> Lines:
        """All lines so far."""
        table = np.array(self._lines, float).reshape(-1, len(_Line._fields))
        line = dict(zip(_Line._fields, table.T, strict=True))
        spacing = np.where(line["kind"] == KINDS.index("hair"), _HAIR_SPACING, _SPACING)
        counts = np.maximum(4, (line["length"] / spacing).astype(np.int64))
        before = lambda n: np.cumsum(n) - n  # noqa: E731
        knots = (_WALKS - 1) * line["place_knots"] + line["strength_knots"]
        firsts = np.stack([before(counts), before(line["corners"]), before(line["length"] + 1.0), before(knots)])
        loud = np.where(np.isin(line["kind"], [KINDS.index(k) for k in _LONG]), 0.25, 0.5)
        rows = np.concatenate([table, counts[:, None], firsts.T, loud[:, None]], 1)
        numbers = np.concatenate([rows.ravel(), *(c.ravel() for c in self._corners), *self._knots])
        return Lines(numbers, len(rows), int(line["corners"].sum()), int(counts.sum()))


def through(controls: np.ndarray, n: int = 40) -> np.ndarray:
    """A smooth polynomial curve of n points through 2 to 4 control points."""
    controls = np.asarray(controls, float)
    k, t = np.linspace(0, 1, len(controls)), np.linspace(0, 1, n)
    powers = np.polyfit(k, controls, min(3, len(controls) - 1))
    return np.stack([np.polyval(powers[:, j], t) for j in range(controls.shape[1])], 1)
