"""Lines on the skin, collected as rows of samples that `ops.surface_lines` draws."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.ops.surface_patterns import surface_lines

KINDS = ("crease", "main", "minor", "fold", "wrinkle", "vein", "tendon", "hair", "halo")
"""Flexion creases of the fingers and wrist; the palm's main and its fine lines; folds over the knuckles; compression
wrinkles; vessels; tendons; hairs; the soft valley along main lines."""
_WIDE = ("vein", "tendon", "halo")
"""Drawn apart: the widest line sets the search's cells."""
_LONG = ("crease", "main", "halo")
_SPACING = 0.25
"""Between samples of one line, and of hairs [mm]."""
_HAIR_SPACING = 0.14


class Strokes:
    """A growing collection of lines; lengths in millimetres."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self._rows: list[np.ndarray] = []  # x, y, z, width, strength, kind

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
        points = np.asarray(points, float)
        along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
        length = along[-1]
        if length < 1e-6:
            return
        t = np.linspace(0, length, max(4, int(length / (_HAIR_SPACING if kind == "hair" else _SPACING))))
        line = np.stack([np.interp(t, along, points[:, k]) for k in range(3)], 1)

        def walk(cell: float) -> np.ndarray:
            knots = np.arange(-1, length / cell + 2) * cell
            return np.interp(t, knots, self.rng.uniform(-1, 1, len(knots)))

        line += wobble * np.stack([walk(5.0) for _ in range(3)], 1)
        u = t / length
        fade = np.clip(np.minimum(u, 1 - u) / max(taper, 1e-3), 0, 1) ** 0.7
        amplitude = strength * fade * (1 + (0.25 if kind in _LONG else 0.5) * walk(4.0))
        widths = width * (1 + 0.2 * walk(5.0))
        self._rows.append(np.c_[line, widths, amplitude, np.full(len(t), KINDS.index(kind))])

    def draw(self, points: Float[Tensor, "N 3"]) -> dict[str, Float[Tensor, "N"]]:
        """The profile of each kind at `points`: the strongest line near by."""
        rows = np.concatenate(self._rows) if self._rows else np.zeros((0, 6))
        rows = rows[rows[:, 4] > 1e-3]
        wide = np.isin(rows[:, 5], [KINDS.index(kind) for kind in _WIDE])
        values = torch.zeros(len(points), len(KINDS), device=points.device)
        for part in (rows[wide], rows[~wide]):
            some = torch.from_numpy(part.astype(np.float32)).to(points.device)
            kinds = some[:, 5].to(torch.int32)
            drawn = surface_lines(
                points, some[:, :3].contiguous(), some[:, 3].contiguous(), some[:, 4].contiguous(), kinds, len(KINDS)
            )
            values = torch.maximum(values, drawn)
        return dict(zip(KINDS, values.unbind(1), strict=True))


def through(controls: np.ndarray, n: int = 40) -> np.ndarray:
    """A smooth curve of n points through 2 to 4 control points (polynomial)."""
    controls = np.asarray(controls, float)
    k, t = np.linspace(0, 1, len(controls)), np.linspace(0, 1, n)
    powers = np.polyfit(k, controls, min(3, len(controls) - 1))
    return np.stack([np.polyval(powers[:, j], t) for j in range(controls.shape[1])], 1)
