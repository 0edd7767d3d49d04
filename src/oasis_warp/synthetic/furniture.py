"""Build rooms of simple solids: their finishes and colours, and the things that hang on walls or lie on tables.

The random numbers of a room are drawn in the order in which arguments stand: changing it changes every picture.
"""

from typing import NamedTuple

import numpy as np

from oasis_warp.synthetic.ops.room_tracing import PATTERNS, SHAPES, SOLID_WORDS
from oasis_warp.synthetic.view_and_light import Vector, rotation_about

MAX_SOLIDS = 26
_WARM = np.array([1.0, 0.1, -1.0])
"""Direction in which the logarithms of paint colours vary most: warm to cool. Green and magenta ones are rare."""


class Finish(NamedTuple):
    """Pattern and colours of a solid."""

    pattern: str
    """One of `room_tracing.PATTERNS`."""
    first: np.ndarray
    """Linear RGB."""
    second: np.ndarray | None = None
    """The pattern's other colour; the same as the first when None."""
    cell: float = 0.1
    """Size of the pattern's cells [m]."""
    gloss: float = 0.0
    glow: float = 0.0


class Builder:
    """Collects the solids of one room, in the room's frame: y down, walls along the axes, metres."""

    def __init__(self, rng: np.random.Generator, yaw: float, pitch: float, roll: float):
        self.rng = rng
        self.to_camera = (
            rotation_about([0, 0, 1], roll) @ rotation_about([1, 0, 0], pitch) @ rotation_about([0, 1, 0], yaw)
        )
        self.rows: list[np.ndarray] = []

    def axis_point(self, distance: float) -> np.ndarray:
        """The point on the camera's axis at a distance, in the room's frame."""
        return self.to_camera.T @ np.array([0.0, 0.0, distance])

    def add(
        self, shape: str, center: Vector, half: Vector, finish: Finish, *, yaw: float = 0.0, tilt: float = 0.0
    ) -> None:
        """Add one solid, unless the room is full.

        Args:
            shape: One of `room_tracing.SHAPES`.
            center: Its middle [m], [3].
            half: Half of its sizes [m], [3].
            finish: Pattern and colours.
            yaw: Rotation about the vertical [rad].
            tilt: Rotation about its own first axis, before `yaw` [rad].
        """
        if len(self.rows) >= MAX_SOLIDS:
            return
        own = rotation_about([0, 1, 0], yaw) @ rotation_about([1, 0, 0], tilt)
        rotation = own.T @ self.to_camera.T
        pattern, first, second, *numbers = finish
        head = [SHAPES.index(shape), PATTERNS.index(pattern), *numbers, float(self.rng.integers(1 << 20))]
        place = self.to_camera @ np.asarray(center, float)
        colors = first, first if second is None else second
        self.rows.append(np.concatenate([head, place, half, rotation.ravel(), *colors]))

    def box(self, center: Vector, half: Vector, finish: Finish, *, yaw: float = 0.0, tilt: float = 0.0) -> None:
        """`add` a box."""
        self.add("box", center, half, finish, yaw=yaw, tilt=tilt)

    def ball(self, center: Vector, half: Vector, finish: Finish, *, yaw: float = 0.0) -> None:
        """`add` an ellipsoid."""
        self.add("ball", center, half, finish, yaw=yaw)

    def cylinder(self, center: Vector, half: Vector, finish: Finish) -> None:
        """`add` an upright cylinder, whose radius is the first of `half`."""
        self.add("cylinder", center, half, finish)

    def matrix(self) -> np.ndarray:
        """All rows, padded to `MAX_SOLIDS`."""
        out = np.zeros((MAX_SOLIDS, SOLID_WORDS), np.float32)
        if self.rows:
            out[: len(self.rows)] = self.rows
        return out

    # Colours, linear RGB.
    def neutral(self, low: float = 0.03, high: float = 0.75) -> np.ndarray:
        """A grey, beige, brown or bluish tone; some are vivid."""
        u, rng = self.rng.uniform, self.rng
        level = np.exp(u(np.log(low), np.log(high)))
        tint = np.exp(rng.normal([0.05, 0.0, -0.08], [0.10, 0.04, 0.14]))
        if rng.random() < 0.12:
            tint = np.exp(rng.normal(0, 0.5) * _WARM + rng.normal(0, 0.14, 3))
        return np.clip(level * tint, 0.008, 0.88)

    def vivid(self) -> np.ndarray:
        """The colour of coloured paper or of a painted wall."""
        rng = self.rng
        return np.clip(rng.uniform(0.1, 0.5) * np.exp(rng.normal(0, 0.5) * _WARM + rng.normal(0, 0.2, 3)), 0.01, 0.8)

    def wood(self) -> np.ndarray:
        """Pale ash to dark walnut."""
        u = self.rng.uniform
        return np.exp(u(np.log(0.05), np.log(0.5))) * np.array([1.0, u(0.5, 0.74), u(0.22, 0.5)])

    def wall_paint(self) -> np.ndarray:
        """Off-white mostly, sometimes coloured."""
        u, rng = self.rng.uniform, self.rng
        base = u(0.35, 0.85) * np.array([1.0, u(0.9, 1.0), u(0.72, 1.0)])
        if rng.random() < 0.3:
            level = np.exp(rng.normal(np.log(0.3), 0.6))
            base = np.clip(level * np.exp(rng.normal(0, 0.25) * _WARM + rng.normal(0, 0.07, 3)), 0.02, 0.85)
        return base

    def surface(self) -> Finish:
        """The finish of a table or floor, without gloss."""
        u, rng = self.rng.uniform, self.rng
        kind = str(rng.choice(["planks", "tiles", "specks", "paint", "carpet"], p=[0.5, 0.13, 0.14, 0.15, 0.08]))
        if kind == "planks":
            a = self.wood()
            return Finish(kind, a, a * u(0.65, 1.5), u(0.05, 0.13))
        if kind == "tiles":
            return Finish(kind, self.neutral(0.1), self.neutral(0.05, 0.4), u(0.1, 0.45))
        if kind == "specks":
            a = self.neutral()
            second = np.clip(a * np.exp(rng.normal(0, 0.7)), 0.01, 0.85)
            return Finish(kind, a, second, np.exp(u(np.log(0.008), np.log(0.1))))
        return Finish(kind, self.neutral(), self.neutral(), u(0.05, 0.3))


def hang_on_wall(build: Builder, z: float, floor: float, spread: float) -> None:
    """Add something that hangs on or leans against the wall at depth `z`."""
    rng, u, neutral = build.rng, build.rng.uniform, build.neutral
    x, y = u(-spread, spread), u(-0.6 * spread, 0.6 * spread)
    white = np.full(3, u(0.5, 0.8))
    match rng.choice(
        ["switch", "socket", "picture", "door", "curtain", "shelf", "poster", "window", "coat", "lamp"],
        p=[0.12, 0.08, 0.16, 0.14, 0.1, 0.14, 0.08, 0.08, 0.06, 0.04],
    ):
        case "switch":
            build.box([x, y, z - 0.006], [0.04, 0.06, 0.006], Finish("paint", white, gloss=0.6))
            build.box([x, y, z - 0.013], [0.017, 0.032, 0.004], Finish("paint", white * 0.95, gloss=0.6))
        case "socket":
            build.box([x, y, z - 0.006], [0.04, 0.04, 0.006], Finish("tiles", white, white * 0.2, 0.03, gloss=0.5))
        case "picture" | "poster":
            w, h = u(0.08, 0.35), u(0.08, 0.35)
            build.box([x, y, z - 0.01], [w + 0.02, h + 0.02, 0.01], Finish("paint", neutral(), gloss=0.4))
            finish = Finish("picture", neutral(), neutral(), u(0.05, 0.3), gloss=0.3)
            build.box([x, y, z - 0.022], [w, h, 0.003], finish)
        case "door":
            color = build.wood() if rng.random() < 0.6 else white
            x, middle = x + np.sign(x) * 0.2, floor - 1.0
            build.box([x, middle, z - 0.02], [0.42, 1.0, 0.02], Finish("panels", color, cell=u(0.5, 0.85), gloss=0.3))
            build.box([x, floor - 2.05, z - 0.03], [0.5, 0.05, 0.03], Finish("paint", color * 0.8))
            build.box([x - 0.47, middle, z - 0.03], [0.05, 1.05, 0.03], Finish("paint", color * 0.85))
            build.ball([x + 0.34, middle, z - 0.07], [0.028] * 3, Finish("paint", np.full(3, 0.55), gloss=2.0))
        case "curtain":
            a, half = neutral(), [u(0.2, 0.5), 1.4, 0.03]
            finish = Finish("stripes", a, a * u(0.35, 0.7), u(0.05, 0.12))
            build.box([x + np.sign(x) * 0.3, 0, z - 0.05], half, finish)
        case "shelf":
            half = [u(0.25, 0.6), u(0.2, 0.7), 0.12]
            finish = Finish("books", build.wood(), cell=u(0.014, 0.03))
            build.box([x + np.sign(x) * 0.15, y, z - 0.12], half, finish)
        case "window":
            half = [u(0.3, 0.6), u(0.35, 0.7), 0.02]
            finish = Finish("panes", np.array([0.7, 0.8, 0.95]), white, u(0.25, 0.5), glow=u(0.5, 3.0))
            build.box([x, y - 0.2, z - 0.01], half, finish)
        case "coat":
            for _ in range(rng.integers(2, 5)):
                center, half = [x + u(-0.15, 0.15), y + u(0, 0.3), z - 0.08], [u(0.06, 0.13), u(0.2, 0.45), 0.07]
                build.ball(center, half, Finish("cloth", neutral(0.01, 0.5), neutral(), u(0.03, 0.3)))
        case "lamp":
            shade, radius = np.array([1, 0.85, 0.6]) * 0.8, u(0.06, 0.12)
            build.ball([x, y - 0.3, z - 0.25], [radius] * 3, Finish("paint", shade, glow=u(1.5, 4)))
            finish = Finish("paint", neutral(0.02, 0.5), gloss=1.0)
            build.cylinder([x, y + 0.5, z - 0.25], [0.012, 0.7, 0.012], finish)


def put_thing(build: Builder, x: float, y: float, z: float) -> None:
    """Add something that stands or lies at (x, z) on a surface of height `y`."""
    rng, u, neutral = build.rng, build.rng.uniform, build.neutral
    yaw = u(-np.pi, np.pi)
    color = neutral()
    match rng.choice(
        ["mug", "paper", "book", "phone", "pen", "box", "ball", "plate", "bottle", "keyboard", "cable", "cloth"],
        p=[0.12, 0.14, 0.13, 0.1, 0.1, 0.1, 0.05, 0.06, 0.07, 0.06, 0.03, 0.04],
    ):
        case "mug":
            r = u(0.035, 0.045)
            build.cylinder([x, y - 0.048, z], [r, 0.048, r], Finish("paint", color, gloss=1.2))
            build.cylinder([x, y - 0.0965, z], [0.85 * r, 0.001, r], Finish("paint", np.array([0.03, 0.015, 0.01])))
            handle = [x + 1.2 * r * np.cos(yaw), y - 0.05, z + 1.2 * r * np.sin(yaw)]
            build.ball(handle, [0.02, 0.027, 0.008], Finish("paint", color, gloss=1.0), yaw=-yaw)
        case "paper":
            for k in range(rng.integers(1, 4)):
                center = [x + u(-0.06, 0.06), y - 0.001 * (k + 1), z + u(-0.06, 0.06)]
                finish = Finish("text", np.full(3, u(0.65, 0.85)), np.full(3, 0.05), u(0.004, 0.008))
                build.box(center, [0.105, 0.001, 0.148], finish, yaw=yaw + u(-0.4, 0.4))
        case "book":
            h = 0.0
            for _ in range(rng.integers(1, 4)):
                t, pattern = u(0.006, 0.02), str(rng.choice(["paint", "picture", "stripes"]))
                half = [u(0.06, 0.12), t, u(0.08, 0.15)]
                finish = Finish(pattern, neutral(), neutral(), u(0.02, 0.1), gloss=0.6)
                build.box([x, y - h - t, z], half, finish, yaw=yaw + u(-0.3, 0.3))
                h += 2 * t
        case "phone":
            build.box([x, y - 0.004, z], [0.036, 0.004, 0.075], Finish("paint", np.full(3, 0.015), gloss=3.0), yaw=yaw)
        case "pen":
            build.box([x, y - 0.004, z], [0.07, 0.004, 0.004], Finish("paint", color, gloss=0.8), yaw=yaw)
        case "box":
            half = np.exp(u(np.log(0.02), np.log(0.12), 3))
            pattern = str(rng.choice(["paint", "picture", "text"]))
            finish = Finish(pattern, color, neutral(), u(0.01, 0.08), gloss=u(0, 0.8))
            build.box([x, y - half[1], z], half, finish, yaw=yaw)
        case "ball":
            r = u(0.02, 0.05)
            build.ball([x, y - r, z], [r] * 3, Finish("paint", color, gloss=u(0, 1.5)))
        case "plate":
            r = u(0.06, 0.11)
            build.cylinder([x, y - 0.008, z], [r, 0.008, r], Finish("paint", np.full(3, u(0.5, 0.8)), gloss=1.2))
            build.ball([x, y - 0.02, z], [0.5 * r, 0.018, 0.5 * r], Finish("specks", neutral(), neutral(), 0.02))
        case "bottle":
            r = u(0.028, 0.042)
            build.cylinder([x, y - 0.09, z], [r, 0.09, r], Finish("paint", color, gloss=2.0))
            build.cylinder([x, y - 0.2, z], [0.4 * r, 0.03, r], Finish("paint", neutral(), gloss=1.0))
        case "keyboard":
            finish = Finish("keys", np.full(3, u(0.01, 0.5)), neutral(), 0.019, gloss=0.3)
            build.box([x, y - 0.008, z], [0.2, 0.008, 0.065], finish, yaw=u(-0.3, 0.3))
        case "cable":
            for k in range(3):
                center, finish = [x + 0.11 * k, y - 0.003, z + 0.05 * np.sin(2 * k)], Finish("paint", np.full(3, 0.03))
                build.box(center, [0.07, 0.003, 0.003], finish, yaw=0.7 * np.sin(2 * k + yaw))
        case "cloth":
            half = [u(0.07, 0.16), 0.03, u(0.07, 0.16)]
            build.ball([x, y - 0.01, z], half, Finish("cloth", color, neutral(), 0.05))


def put_laptop(build: Builder, x: float, y: float, z: float) -> None:
    """Add a laptop that faces the camera: keyboard in front, screen behind."""
    rng, u = build.rng, build.rng.uniform
    body = np.full(3, float(rng.choice([0.02, 0.35, 0.5])))
    yaw = u(-0.4, 0.4)
    build.box([x, y - 0.008, z], [0.16, 0.008, 0.11], Finish("paint", body, gloss=0.8), yaw=yaw)
    keys = [x - 0.03 * np.sin(yaw), y - 0.0165, z + 0.03]
    build.box(keys, [0.145, 0.001, 0.055], Finish("keys", np.full(3, 0.012), body, 0.019), yaw=yaw)
    pattern = str(rng.choice(["picture", "text"]))
    first = np.full(3, 0.85) if rng.random() < 0.5 else build.neutral()
    finish = Finish(pattern, first, build.neutral(), u(0.004, 0.1), glow=u(0.2, 1.2), gloss=0.8)
    screen = [x + 0.12 * np.sin(yaw), y - 0.115, z + 0.12 * np.cos(yaw) + 0.03]
    build.box(screen, [0.155, 0.1, 0.004], finish, yaw=yaw, tilt=0.25)
