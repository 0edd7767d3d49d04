"""Things of a few solids: what hangs on walls and lies on tables, and the colours of paints, woods and cloths."""

import numpy as np

from oasis_warp.synthetic.ops.room_tracing import PATTERNS, SHAPES, SOLID_WORDS
from oasis_warp.synthetic.view_and_light import Vector, rotation_about

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


def hang_on_wall(build: Builder, z: float, floor: float, spread: float) -> None:
    """Something that hangs on or leans against the wall at depth `z`."""
    rng, u = build.rng, build.rng.uniform
    x, y = u(-spread, spread), u(-0.6 * spread, 0.6 * spread)
    white = np.full(3, u(0.5, 0.8))
    match rng.choice(
        ["switch", "socket", "picture", "door", "curtain", "shelf", "poster", "window", "coat", "lamp"],
        p=[0.12, 0.08, 0.16, 0.14, 0.1, 0.14, 0.08, 0.08, 0.06, 0.04],
    ):
        case "switch":
            build.add("box", "paint", [x, y, z - 0.006], [0.04, 0.06, 0.006], white, gloss=0.6)
            build.add("box", "paint", [x, y, z - 0.013], [0.017, 0.032, 0.004], white * 0.95, gloss=0.6)
        case "socket":
            build.add("box", "tiles", [x, y, z - 0.006], [0.04, 0.04, 0.006], white, white * 0.2, cell=0.03, gloss=0.5)
        case "picture" | "poster":
            w, h = u(0.08, 0.35), u(0.08, 0.35)
            frame = build.neutral()
            build.add("box", "paint", [x, y, z - 0.01], [w + 0.02, h + 0.02, 0.01], frame, gloss=0.4)
            build.add(
                "box",
                "picture",
                [x, y, z - 0.022],
                [w, h, 0.003],
                build.neutral(),
                build.neutral(),
                cell=u(0.05, 0.3),
                gloss=0.3,
            )
        case "door":
            color = build.wood() if rng.random() < 0.6 else white
            x = x + np.sign(x) * 0.2
            build.add(
                "box", "panels", [x, floor - 1.0, z - 0.02], [0.42, 1.0, 0.02], color, cell=u(0.5, 0.85), gloss=0.3
            )
            build.add("box", "paint", [x, floor - 2.05, z - 0.03], [0.5, 0.05, 0.03], color * 0.8)
            build.add("box", "paint", [x - 0.47, floor - 1.0, z - 0.03], [0.05, 1.05, 0.03], color * 0.85)
            build.add("ball", "paint", [x + 0.34, floor - 1.0, z - 0.07], [0.028] * 3, np.full(3, 0.55), gloss=2.0)
        case "curtain":
            a = build.neutral()
            build.add(
                "box",
                "stripes",
                [x + np.sign(x) * 0.3, 0, z - 0.05],
                [u(0.2, 0.5), 1.4, 0.03],
                a,
                a * u(0.35, 0.7),
                cell=u(0.05, 0.12),
            )
        case "shelf":
            w, h = u(0.25, 0.6), u(0.2, 0.7)
            build.add(
                "box", "books", [x + np.sign(x) * 0.15, y, z - 0.12], [w, h, 0.12], build.wood(), cell=u(0.014, 0.03)
            )
        case "window":
            build.add(
                "box",
                "panes",
                [x, y - 0.2, z - 0.01],
                [u(0.3, 0.6), u(0.35, 0.7), 0.02],
                np.array([0.7, 0.8, 0.95]),
                white,
                cell=u(0.25, 0.5),
                glow=u(0.5, 3.0),
            )
        case "coat":
            for _ in range(rng.integers(2, 5)):
                build.add(
                    "ball",
                    "cloth",
                    [x + u(-0.15, 0.15), y + u(0, 0.3), z - 0.08],
                    [u(0.06, 0.13), u(0.2, 0.45), 0.07],
                    build.neutral(0.01, 0.5),
                    build.neutral(),
                    cell=u(0.03, 0.3),
                )
        case "lamp":
            build.add(
                "ball",
                "paint",
                [x, y - 0.3, z - 0.25],
                [u(0.06, 0.12)] * 3,
                np.array([1, 0.85, 0.6]) * 0.8,
                glow=u(1.5, 4),
            )
            build.add(
                "cylinder", "paint", [x, y + 0.5, z - 0.25], [0.012, 0.7, 0.012], build.neutral(0.02, 0.5), gloss=1.0
            )


def put_thing(build: Builder, x: float, y: float, z: float) -> None:
    """Something that stands or lies at (x, z) on a surface of height `y`."""
    rng, u = build.rng, build.rng.uniform
    yaw = u(-np.pi, np.pi)
    color = build.neutral()
    match rng.choice(
        ["mug", "paper", "book", "phone", "pen", "box", "ball", "plate", "bottle", "keyboard", "cable", "cloth"],
        p=[0.12, 0.14, 0.13, 0.1, 0.1, 0.1, 0.05, 0.06, 0.07, 0.06, 0.03, 0.04],
    ):
        case "mug":
            r = u(0.035, 0.045)
            build.add("cylinder", "paint", [x, y - 0.048, z], [r, 0.048, r], color, gloss=1.2)
            build.add("cylinder", "paint", [x, y - 0.0965, z], [0.85 * r, 0.001, r], np.array([0.03, 0.015, 0.01]))
            build.add(
                "ball",
                "paint",
                [x + 1.2 * r * np.cos(yaw), y - 0.05, z + 1.2 * r * np.sin(yaw)],
                [0.02, 0.027, 0.008],
                color,
                gloss=1.0,
                yaw=-yaw,
            )
        case "paper":
            for k in range(rng.integers(1, 4)):
                build.add(
                    "box",
                    "text",
                    [x + u(-0.06, 0.06), y - 0.001 * (k + 1), z + u(-0.06, 0.06)],
                    [0.105, 0.001, 0.148],
                    np.full(3, u(0.65, 0.85)),
                    np.full(3, 0.05),
                    cell=u(0.004, 0.008),
                    yaw=yaw + u(-0.4, 0.4),
                )
        case "book":
            h = 0.0
            for _ in range(rng.integers(1, 4)):
                t = u(0.006, 0.02)
                build.add(
                    "box",
                    str(rng.choice(["paint", "picture", "stripes"])),
                    [x, y - h - t, z],
                    [u(0.06, 0.12), t, u(0.08, 0.15)],
                    build.neutral(),
                    build.neutral(),
                    cell=u(0.02, 0.1),
                    gloss=0.6,
                    yaw=yaw + u(-0.3, 0.3),
                )
                h += 2 * t
        case "phone":
            build.add("box", "paint", [x, y - 0.004, z], [0.036, 0.004, 0.075], np.full(3, 0.015), gloss=3.0, yaw=yaw)
        case "pen":
            build.add("box", "paint", [x, y - 0.004, z], [0.07, 0.004, 0.004], color, gloss=0.8, yaw=yaw)
        case "box":
            s = np.exp(u(np.log(0.02), np.log(0.12), 3))
            build.add(
                "box",
                str(rng.choice(["paint", "picture", "text"])),
                [x, y - s[1], z],
                s,
                color,
                build.neutral(),
                cell=u(0.01, 0.08),
                gloss=u(0, 0.8),
                yaw=yaw,
            )
        case "ball":
            r = u(0.02, 0.05)
            build.add("ball", "paint", [x, y - r, z], [r] * 3, color, gloss=u(0, 1.5))
        case "plate":
            r = u(0.06, 0.11)
            build.add("cylinder", "paint", [x, y - 0.008, z], [r, 0.008, r], np.full(3, u(0.5, 0.8)), gloss=1.2)
            build.add(
                "ball",
                "specks",
                [x, y - 0.02, z],
                [0.5 * r, 0.018, 0.5 * r],
                build.neutral(),
                build.neutral(),
                cell=0.02,
            )
        case "bottle":
            r = u(0.028, 0.042)
            build.add("cylinder", "paint", [x, y - 0.09, z], [r, 0.09, r], color, gloss=2.0)
            build.add("cylinder", "paint", [x, y - 0.2, z], [0.4 * r, 0.03, r], build.neutral(), gloss=1.0)
        case "keyboard":
            build.add(
                "box",
                "keys",
                [x, y - 0.008, z],
                [0.2, 0.008, 0.065],
                np.full(3, u(0.01, 0.5)),
                build.neutral(),
                cell=0.019,
                gloss=0.3,
                yaw=u(-0.3, 0.3),
            )
        case "cable":
            for k in range(3):
                build.add(
                    "box",
                    "paint",
                    [x + 0.11 * k, y - 0.003, z + 0.05 * np.sin(2 * k)],
                    [0.07, 0.003, 0.003],
                    np.full(3, 0.03),
                    yaw=0.7 * np.sin(2 * k + yaw),
                )
        case "cloth":
            build.add(
                "ball",
                "cloth",
                [x, y - 0.01, z],
                [u(0.07, 0.16), 0.03, u(0.07, 0.16)],
                color,
                build.neutral(),
                cell=0.05,
            )


def put_laptop(build: Builder, x: float, y: float, z: float) -> None:
    """Keyboard below, screen behind, as one sits before it."""
    rng, u = build.rng, build.rng.uniform
    body = np.full(3, float(rng.choice([0.02, 0.35, 0.5])))
    yaw = u(-0.4, 0.4)
    build.add("box", "paint", [x, y - 0.008, z], [0.16, 0.008, 0.11], body, gloss=0.8, yaw=yaw)
    build.add(
        "box",
        "keys",
        [x - 0.03 * np.sin(yaw), y - 0.0165, z + 0.03],
        [0.145, 0.001, 0.055],
        np.full(3, 0.012),
        body,
        cell=0.019,
        yaw=yaw,
    )
    build.add(
        "box",
        str(rng.choice(["picture", "text"])),
        [x + 0.12 * np.sin(yaw), y - 0.115, z + 0.12 * np.cos(yaw) + 0.03],
        [0.155, 0.1, 0.004],
        np.full(3, 0.85) if rng.random() < 0.5 else build.neutral(),
        build.neutral(),
        cell=u(0.004, 0.1),
        glow=u(0.2, 1.2),
        gloss=0.8,
        yaw=yaw,
        tilt=0.25,
    )
