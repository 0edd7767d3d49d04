"""Collect the solids of a room, and mix the colours of its paints, woods and cloths."""

import numpy as np

from oasis_warp.synthetic.ops.room_tracing import PATTERNS, SHAPES, SOLID_WORDS
from oasis_warp.synthetic.stage import Vector, rotation_about

MAX_SOLIDS = 26
_WARM = np.array([1.0, 0.1, -1.0])
"""Paints and cloths differ most between warm and cool; green and magenta ones are rare."""


class Builder:
    """Collects solids in the room's frame."""

    def __init__(self, rng: np.random.Generator, yaw: float, pitch: float, roll: float):
        self.rng = rng
        self.to_camera = (
            rotation_about([0, 0, 1], roll) @ rotation_about([1, 0, 0], pitch) @ rotation_about([0, 1, 0], yaw)
        )
        self.rows: list[np.ndarray] = []

    def axis_point(self, distance: float) -> np.ndarray:
        """The point of the camera's axis at a distance, in the room's frame."""
        return self.to_camera.T @ np.array([0.0, 0.0, distance])

    def add(
        self,
        shape: str,
        pattern: str,
        center: Vector,
        half: Vector,
        first: np.ndarray,
        second: np.ndarray | None = None,
        *,
        cell: float = 0.1,
        gloss: float = 0.0,
        glow: float = 0.0,
        yaw: float = 0.0,
        tilt: float = 0.0,
    ) -> None:
        """One solid; `yaw` turns it about the vertical, `tilt` then about its own first axis."""
        if len(self.rows) >= MAX_SOLIDS:
            return
        own = rotation_about([0, 1, 0], yaw) @ rotation_about([1, 0, 0], tilt)
        turn = own.T @ self.to_camera.T
        seed = float(self.rng.integers(1 << 20))
        head = [SHAPES.index(shape), PATTERNS.index(pattern), cell, gloss, glow, seed]
        second = first if second is None else second
        place = self.to_camera @ np.asarray(center, float)
        self.rows.append(np.concatenate([head, place, half, turn.ravel(), first, second]))

    # Colours, linear.
    def neutral(self, low: float = 0.03, high: float = 0.75) -> np.ndarray:
        """A grey, beige, brown or bluish tone; some are vivid."""
        u, rng = self.rng.uniform, self.rng
        level = np.exp(u(np.log(low), np.log(high)))
        tint = np.exp(rng.normal([0.05, 0.0, -0.08], [0.10, 0.04, 0.14]))
        if rng.random() < 0.12:
            tint = np.exp(rng.normal(0, 0.5) * _WARM + rng.normal(0, 0.14, 3))
        return np.clip(level * tint, 0.008, 0.88)

    def vivid(self) -> np.ndarray:
        """A plainly coloured paper or wall."""
        rng = self.rng
        return np.clip(rng.uniform(0.1, 0.5) * np.exp(rng.normal(0, 0.5) * _WARM + rng.normal(0, 0.2, 3)), 0.01, 0.8)

    def wood(self) -> np.ndarray:
        """Pale ash to dark walnut."""
        u = self.rng.uniform
        return np.exp(u(np.log(0.05), np.log(0.5))) * np.array([1.0, u(0.5, 0.74), u(0.22, 0.5)])

    def wall_paint(self) -> np.ndarray:
        """Mostly off-white, some coloured."""
        u, rng = self.rng.uniform, self.rng
        base = u(0.35, 0.85) * np.array([1.0, u(0.9, 1.0), u(0.72, 1.0)])
        if rng.random() < 0.3:
            base = np.clip(
                np.exp(rng.normal(np.log(0.3), 0.6)) * np.exp(rng.normal(0, 0.25) * _WARM + rng.normal(0, 0.07, 3)),
                0.02,
                0.85,
            )
        return base

    def surface(self) -> tuple[str, np.ndarray, np.ndarray, float]:
        """Pattern, colours and cell of a table or floor."""
        u, rng = self.rng.uniform, self.rng
        kind = rng.choice(["planks", "tiles", "specks", "paint", "carpet"], p=[0.5, 0.13, 0.14, 0.15, 0.08])
        if kind == "planks":
            a = self.wood()
            return kind, a, a * u(0.65, 1.5), u(0.05, 0.13)
        if kind == "tiles":
            return kind, self.neutral(0.1), self.neutral(0.05, 0.4), u(0.1, 0.45)
        if kind == "specks":
            a = self.neutral()
            return kind, a, np.clip(a * np.exp(rng.normal(0, 0.7)), 0.01, 0.85), np.exp(u(np.log(0.008), np.log(0.1)))
        return kind, self.neutral(), self.neutral(), u(0.05, 0.3)

    def matrix(self) -> np.ndarray:
        """All rows, padded."""
        out = np.zeros((MAX_SOLIDS, SOLID_WORDS), np.float32)
        if self.rows:
            out[: len(self.rows)] = self.rows
        return out
