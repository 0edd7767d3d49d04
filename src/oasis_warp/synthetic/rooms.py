"""What stands behind the hand: walls, desks, floors, whole rooms, cloth, gardens, studios, built of a few solids.

Rooms are built round the camera with y down and walls along the axes, then turned into the camera's frame. Metres.
"""

from typing import NamedTuple

import numpy as np

from oasis_warp.synthetic.furniture import Builder, hang_on_wall, put_laptop, put_thing

_KINDS = {"wall": 0.24, "desk": 0.24, "floor": 0.13, "room": 0.20, "cloth": 0.08, "garden": 0.05, "studio": 0.06}


class Room(NamedTuple):
    """Of one picture."""

    kind: str
    solids: np.ndarray
    """Rows for `synthetic.ops.room_tracing.trace_rooms`, in the camera's frame (`solids.Builder.matrix`)."""
    aperture: float
    """Radius of the blur of things far off, over the width of the picture."""


def sample_room(rng: np.random.Generator, distance: float, reach: float) -> Room:
    """A room behind a hand.

    Args:
        rng: Source of everything.
        distance: Of the hand's middle from the camera [m].
        reach: Of the hand beyond its middle [m].
    """
    kind = str(rng.choice(list(_KINDS), p=list(_KINDS.values())))
    u = rng.uniform
    down = {"desk": u(0.3, 1.3), "floor": u(0.7, 1.45), "cloth": u(0.1, 1.4), "garden": u(-0.1, 0.35)}
    pitch = down.get(kind, rng.normal(0.05, 0.10))
    build = Builder(rng, rng.normal(0, 0.45), pitch, rng.normal(0, 0.07))
    back = distance + reach
    {
        "wall": _wall,
        "desk": _desk,
        "floor": _floor,
        "room": _room,
        "cloth": _cloth,
        "garden": _garden,
        "studio": _studio,
    }[kind](build, back)
    aperture = float(np.exp(u(np.log(0.0015), np.log(0.035)))) * {"room": 1.6}.get(kind, 1.0)
    if kind == "garden":
        aperture = u(0.02, 0.07)
    return Room(kind, build.matrix(), aperture)


def _wall(build: Builder, back: float) -> None:
    rng, u = build.rng, build.rng.uniform
    z = build.axis_point(back + np.exp(u(np.log(0.03), np.log(1.3))))[2]
    floor = u(0.7, 1.5)
    paint = build.wall_paint()
    pattern, second, cell = "paint", paint, 0.3
    if rng.random() < 0.28:
        pattern = str(rng.choice(["panels", "stripes", "specks", "tiles", "planks"]))
        second, cell = paint * u(0.75, 0.95), u(0.06, 0.8)
        if pattern in ("panels", "planks"):
            paint = build.wood()
            second = paint * u(0.8, 1.25)
    build.add("box", pattern, [0, 0, z + 0.05], [6, 3, 0.05], paint, second, cell=cell, gloss=0.15)
    kind, a, b, size = build.surface()
    build.add("box", kind, [0, floor + 0.05, z - 2], [6, 0.05, 2.0], a, b, cell=size, gloss=0.5)
    build.add("box", "paint", [0, floor - 0.05, z - 0.008], [6, 0.05, 0.008], np.full(3, 0.6))
    if rng.random() < 0.35:
        side = rng.choice([-1, 1])
        build.add("box", "paint", [side * u(0.25, 1.2) + side * 0.05, 0, z - 1], [0.05, 3, 1.0], paint * u(0.7, 1.0))
    for _ in range(rng.integers(0, 5)):
        hang_on_wall(build, z, floor, u(0.1, 0.6) * (0.3 + z))


def _desk(build: Builder, back: float) -> None:
    rng, u = build.rng, build.rng.uniform
    gaze = build.axis_point(back + np.exp(u(np.log(0.03), np.log(0.4))))
    y = max(gaze[1], 0.05)
    kind, a, b, cell = build.surface()
    build.add(
        "box", kind, [gaze[0], y + 0.015, gaze[2]], [0.9, 0.015, u(0.35, 0.6)], a, b, cell=cell, gloss=u(0.1, 1.2)
    )
    floor_kind, c, d, size = build.surface()
    build.add("box", floor_kind, [0, y + 0.75, gaze[2]], [5, 0.02, 5], c, d, cell=size, gloss=0.4)
    build.add("box", "paint", [0, 0, gaze[2] + u(0.6, 2.0)], [5, 3, 0.05], build.wall_paint())
    if rng.random() < 0.4:
        put_laptop(build, gaze[0] + u(-0.25, 0.25), y, gaze[2] + u(0.0, 0.25))
    for _ in range(rng.integers(2, 9)):
        put_thing(build, gaze[0] + rng.normal(0, 0.22), y, gaze[2] + rng.normal(0.04, 0.2))
    if rng.random() < 0.3:
        hang_on_wall(build, gaze[2] + 0.6, y + 0.7, 0.8)


def _floor(build: Builder, back: float) -> None:
    rng, u = build.rng, build.rng.uniform
    gaze = build.axis_point(back + u(0.35, 1.3))
    y = max(gaze[1], 0.4)
    kind, a, b, cell = build.surface()
    build.add("box", kind, [0, y + 0.05, gaze[2]], [6, 0.05, 6], a, b, cell=cell, gloss=u(0.2, 1.2))
    if rng.random() < 0.35:
        build.add(
            "box",
            "carpet",
            [gaze[0] + u(-0.8, 0.8), y - 0.004, gaze[2] + u(-0.8, 0.8)],
            [u(0.4, 1.0), 0.005, u(0.4, 1.2)],
            build.neutral(),
            build.neutral(),
            cell=u(0.15, 0.6),
            yaw=u(-0.5, 0.5),
        )
    build.add("box", "paint", [0, y - 1.5, gaze[2] + u(0.5, 2.5)], [6, 1.5, 0.05], build.wall_paint())
    for _ in range(rng.integers(1, 6)):
        x, z = gaze[0] + rng.normal(0, 0.5), gaze[2] + rng.normal(0.1, 0.5)
        match rng.choice(["leg", "shoe", "furniture", "bag", "stand", "small"], p=[0.2, 0.2, 0.25, 0.12, 0.08, 0.15]):
            case "leg":
                build.add(
                    "cylinder",
                    "paint",
                    [x, y - 0.4, z],
                    [u(0.015, 0.04), 0.4, 0.03],
                    build.neutral(0.01, 0.5),
                    gloss=0.8,
                )
            case "shoe":
                color, yaw = build.neutral(0.01, 0.5), u(-3, 3)
                for side in (-0.06, 0.06):
                    build.add(
                        "ball",
                        "paint",
                        [x + side * np.cos(yaw), y - 0.035, z - side * np.sin(yaw)],
                        [0.047, 0.045, 0.14],
                        color,
                        gloss=0.5,
                        yaw=yaw,
                    )
            case "furniture":
                s = u([0.15, 0.15, 0.15], [0.6, 0.45, 0.5])
                build.add(
                    "box",
                    str(rng.choice(["panels", "cloth", "paint"])),
                    [x + np.sign(x) * 0.3, y - s[1], z],
                    s,
                    build.wood() if rng.random() < 0.5 else build.neutral(),
                    build.neutral(),
                    cell=u(0.1, 0.5),
                    yaw=u(-0.4, 0.4),
                )
            case "bag":
                build.add(
                    "ball",
                    "cloth",
                    [x, y - 0.1, z],
                    u([0.1, 0.08, 0.1], [0.25, 0.18, 0.25]),
                    build.neutral(0.01, 0.4),
                    build.neutral(),
                    cell=0.2,
                )
            case "stand":
                build.add("cylinder", "paint", [x, y - 0.012, z], [0.14, 0.012, 0.14], np.full(3, 0.4), gloss=2.0)
                build.add("cylinder", "paint", [x, y - 0.7, z], [0.011, 0.7, 0.011], np.full(3, 0.35), gloss=2.0)
            case "small":
                put_thing(build, x, y, z)


def _room(build: Builder, back: float) -> None:
    rng, u = build.rng, build.rng.uniform
    z, floor = back + u(1.2, 4.0), u(0.6, 1.45)
    left, right = -u(0.8, 3.0), u(0.8, 3.0)
    paint = build.wall_paint()
    build.add("box", "paint", [0, 0, z + 0.05], [7, 4, 0.05], paint)
    kind, a, b, cell = build.surface()
    build.add("box", kind, [0, floor + 0.05, z / 2], [7, 0.05, 6], a, b, cell=cell, gloss=u(0.2, 1.0))
    build.add("box", "paint", [0, floor - 2.5, z / 2], [7, 0.05, 6], np.full(3, 0.75))
    for x in (left, right):
        if rng.random() < 0.7:
            build.add("box", "paint", [x + np.sign(x) * 0.05, 0, z / 2], [0.05, 4, 6], paint * u(0.75, 1.0))
    for _ in range(rng.integers(1, 4)):
        hang_on_wall(build, z, floor, 1.6)
    for _ in range(rng.integers(2, 6)):
        x, at = u(left, right), u(0.45, 0.95) * z
        match rng.choice(["sofa", "table", "cabinet", "chair", "plant", "shelf"], p=[0.2, 0.2, 0.2, 0.15, 0.1, 0.15]):
            case "sofa":
                c = build.neutral(0.02, 0.6)
                build.add("box", "cloth", [x, floor - 0.22, at], [0.8, 0.22, 0.4], c, c, cell=0.6)
                build.add("box", "cloth", [x, floor - 0.55, at + 0.32], [0.8, 0.35, 0.1], c, c, cell=0.6)
                build.add(
                    "ball",
                    "cloth",
                    [x + u(-0.6, 0.6), floor - 0.55, at + 0.1],
                    [0.22, 0.2, 0.1],
                    build.neutral(),
                    build.neutral(),
                    cell=0.1,
                    yaw=u(-0.5, 0.5),
                )
            case "table":
                c = build.wood()
                build.add("box", "planks", [x, floor - 0.73, at], [u(0.3, 0.7), 0.02, 0.4], c, c, cell=0.1, gloss=0.6)
                for side in (-0.28, 0.28):
                    build.add("box", "paint", [x + side, floor - 0.36, at], [0.025, 0.36, 0.025], c * 0.8)
                put_thing(build, x, floor - 0.75, at)
            case "cabinet":
                build.add(
                    "box",
                    "panels",
                    [x, floor - 0.45, at],
                    [u(0.3, 0.6), u(0.35, 0.9), 0.25],
                    build.wood(),
                    cell=u(0.3, 0.6),
                )
            case "chair":
                c = build.neutral(0.01, 0.5)
                build.add("box", "cloth", [x, floor - 0.45, at], [0.22, 0.03, 0.22], c, c, cell=0.3)
                build.add("box", "cloth", [x, floor - 0.75, at + 0.2], [0.2, 0.25, 0.025], c, c, cell=0.3)
                build.add("cylinder", "paint", [x, floor - 0.22, at], [0.03, 0.22, 0.03], np.full(3, 0.1), gloss=1.0)
            case "plant":
                build.add("cylinder", "paint", [x, floor - 0.15, at], [0.14, 0.15, 0.14], build.neutral())
                build.add(
                    "ball",
                    "leaves",
                    [x, floor - 0.7, at],
                    [0.3, 0.45, 0.3],
                    np.array([0.06, 0.10, 0.04]),
                    np.array([0.015, 0.025, 0.012]),
                    cell=0.12,
                )
            case "shelf":
                build.add("box", "books", [x, floor - 0.9, at], [0.4, 0.9, 0.15], build.wood(), cell=u(0.018, 0.035))


def _cloth(build: Builder, back: float) -> None:
    """A bed, a sofa, a lap."""
    rng, u = build.rng, build.rng.uniform
    gaze = build.axis_point(back + u(0.02, 0.25))
    y = max(gaze[1], 0.03)
    a = build.neutral(0.015, 0.7)
    build.add(
        "box",
        "cloth",
        [gaze[0], y + 0.15, gaze[2]],
        [1.5, 0.15, 1.2],
        a,
        np.clip(a * np.exp(rng.normal(0, 0.6)), 0.01, 0.8),
        cell=np.exp(u(np.log(0.02), np.log(0.6))),
    )
    for _ in range(rng.integers(1, 4)):  # folds
        build.add(
            "ball",
            "cloth",
            [gaze[0] + rng.normal(0, 0.4), y + 0.03, gaze[2] + rng.normal(0, 0.3)],
            u([0.2, 0.03, 0.02], [0.6, 0.06, 0.07]),
            a,
            a,
            cell=0.3,
            yaw=u(-3, 3),
        )
    for _ in range(rng.integers(0, 4)):
        c = build.neutral()
        build.add(
            "ball",
            "cloth",
            [gaze[0] + rng.normal(0, 0.5), y - 0.04, gaze[2] + u(0.25, 0.8)],
            [0.3, 0.13, 0.22],
            c,
            build.neutral(),
            cell=u(0.03, 0.3),
            yaw=u(-3, 3),
        )
    build.add("box", "paint", [0, 0, gaze[2] + u(0.8, 2.5)], [6, 3, 0.05], build.wall_paint())


def _garden(build: Builder, back: float) -> None:
    rng, u = build.rng, build.rng.uniform
    z, ground = back + u(3, 12), u(1.0, 1.5)
    build.add("box", "paint", [0, -10, z + 20], [60, 40, 0.1], np.array([0.5, 0.65, 0.9]), glow=u(0.6, 1.4))
    leaf, dark = u(0.5, 1.2) * np.array([u(0.07, 0.16), u(0.11, 0.17), u(0.03, 0.07)]), np.array([0.018, 0.028, 0.012])
    path = rng.random() < 0.4
    build.add(
        "box",
        "specks" if path else "leaves",
        [0, ground + 0.05, z],
        [40, 0.05, 30],
        build.neutral() if path else leaf,
        build.neutral(0.05, 0.4) if path else dark,
        cell=u(0.03, 0.15),
    )
    for _ in range(rng.integers(3, 9)):
        x, at = rng.normal(0, 0.45) * z, u(0.4, 1.0) * z
        match rng.choice(["bush", "trunk", "house"], p=[0.6, 0.2, 0.2]):
            case "bush":
                s = u([0.4, 0.4, 0.4], [2.2, 1.8, 1.5])
                build.add("ball", "leaves", [x, ground - 0.7 * s[1], at], s, leaf * u(0.6, 1.4), dark, cell=u(0.1, 0.4))
            case "trunk":
                build.add(
                    "cylinder",
                    "specks",
                    [x, ground - 2, at],
                    [u(0.05, 0.25), 2.2, 0.2],
                    np.array([0.1, 0.07, 0.05]),
                    np.array([0.03, 0.02, 0.015]),
                    cell=0.1,
                )
            case "house":
                build.add(
                    "box",
                    "tiles",
                    [x, ground - 2.5, z + 3],
                    [u(2, 5), 2.5, 2],
                    build.wall_paint(),
                    np.full(3, 0.05),
                    cell=u(0.8, 1.6),
                )


def _studio(build: Builder, back: float) -> None:
    """A plain ground close behind."""
    rng, u = build.rng, build.rng.uniform
    color = (
        np.full(3, u(0.5, 0.88)),
        np.full(3, u(0.01, 0.1)),
        build.neutral(),
        build.vivid(),
    )[rng.choice(4, p=[0.4, 0.2, 0.28, 0.12])]
    z = build.axis_point(back + np.exp(u(np.log(0.02), np.log(0.8))))[2]
    build.add("box", "paint", [0, 0, z + 0.05], [8, 8, 0.05], color, gloss=0.1)
