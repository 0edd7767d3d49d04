"""What stands behind the hand: walls, desks, floors, rooms, cloth, gardens and studios of a few solids, or a picture.

Rooms are built around the camera with y down and walls along the axes, then rotated into the camera's frame. Metres.
"""

import functools
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.synthetic.furniture import Builder, Finish, hang_on_wall, put_laptop, put_thing

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif")
CACHED = 64
"""Decoded pictures that are cached."""
MAX_PIXELS = 1_000_000
"""Larger pictures are scaled down: no background shows more pixels."""


class Room(NamedTuple):
    """The background of one picture."""

    kind: str
    """One of `KINDS`."""
    solids: np.ndarray
    """Rows for `synthetic.ops.room_tracing.trace_rooms`, in the camera's frame (`furniture.Builder.matrix`)."""
    aperture: float
    """Blur radius of distant things, as a share of the picture's width."""


MAX_YAW = 1.5
"""Largest rotation of a room about the vertical [rad]: beyond a right angle its wall would be behind the camera."""


def sample_room(rng: np.random.Generator, distance: float, reach: float) -> Room:
    """Draw the room behind a hand.

    Args:
        rng: Source of all randomness.
        distance: From the camera to the hand's middle [m].
        reach: How far the hand extends beyond its middle [m].
    """
    kind = str(rng.choice(list(KINDS), p=[share for share, _ in KINDS.values()]))
    u = rng.uniform
    down = {"desk": u(0.3, 1.3), "floor": u(0.7, 1.45), "cloth": u(0.1, 1.4), "garden": u(-0.1, 0.35)}
    pitch = down.get(kind, rng.normal(0.05, 0.10))
    yaw = float(np.clip(rng.normal(0, 0.45), -MAX_YAW, MAX_YAW))
    build = Builder(rng, yaw, pitch, rng.normal(0, 0.07))
    KINDS[kind][1](build, distance + reach)
    aperture = float(np.exp(u(np.log(0.0015), np.log(0.035)))) * (1.6 if kind == "room" else 1.0)
    if kind == "garden":
        aperture = u(0.02, 0.07)
    return Room(kind, build.matrix(), aperture)


def _wall(build: Builder, back: float) -> None:
    """A wall close behind the hand, with up to four things on it."""
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
    build.box([0, 0, z + 0.05], [6, 3, 0.05], Finish(pattern, paint, second, cell, gloss=0.15))
    build.box([0, floor + 0.05, z - 2], [6, 0.05, 2.0], build.surface()._replace(gloss=0.5))
    build.box([0, floor - 0.05, z - 0.008], [6, 0.05, 0.008], Finish("paint", np.full(3, 0.6)))
    if rng.random() < 0.35:
        side = rng.choice([-1, 1])
        build.box([side * u(0.25, 1.2) + side * 0.05, 0, z - 1], [0.05, 3, 1.0], Finish("paint", paint * u(0.7, 1.0)))
    for _ in range(rng.integers(0, 5)):
        hang_on_wall(build, z, floor, u(0.1, 0.6) * (0.3 + z))


def _desk(build: Builder, back: float) -> None:
    """A table top below the hand, with things on it."""
    rng, u = build.rng, build.rng.uniform
    gaze = build.axis_point(back + np.exp(u(np.log(0.03), np.log(0.4))))
    y = max(gaze[1], 0.05)
    top, half = build.surface(), [0.9, 0.015, u(0.35, 0.6)]
    build.box([gaze[0], y + 0.015, gaze[2]], half, top._replace(gloss=u(0.1, 1.2)))
    build.box([0, y + 0.75, gaze[2]], [5, 0.02, 5], build.surface()._replace(gloss=0.4))
    build.box([0, 0, gaze[2] + u(0.6, 2.0)], [5, 3, 0.05], Finish("paint", build.wall_paint()))
    if rng.random() < 0.4:
        put_laptop(build, gaze[0] + u(-0.25, 0.25), y, gaze[2] + u(0.0, 0.25))
    for _ in range(rng.integers(2, 9)):
        put_thing(build, gaze[0] + rng.normal(0, 0.22), y, gaze[2] + rng.normal(0.04, 0.2))
    if rng.random() < 0.3:
        hang_on_wall(build, gaze[2] + 0.6, y + 0.7, 0.8)


def _floor(build: Builder, back: float) -> None:
    """A floor seen from above, with a few things that stand on it."""
    rng, u = build.rng, build.rng.uniform
    gaze = build.axis_point(back + u(0.35, 1.3))
    y = max(gaze[1], 0.4)
    build.box([0, y + 0.05, gaze[2]], [6, 0.05, 6], build.surface()._replace(gloss=u(0.2, 1.2)))
    if rng.random() < 0.35:
        center = [gaze[0] + u(-0.8, 0.8), y - 0.004, gaze[2] + u(-0.8, 0.8)]
        half = [u(0.4, 1.0), 0.005, u(0.4, 1.2)]
        finish = Finish("carpet", build.neutral(), build.neutral(), u(0.15, 0.6))
        build.box(center, half, finish, yaw=u(-0.5, 0.5))
    build.box([0, y - 1.5, gaze[2] + u(0.5, 2.5)], [6, 1.5, 0.05], Finish("paint", build.wall_paint()))
    for _ in range(rng.integers(1, 6)):
        _stand_on_floor(build, gaze[0] + rng.normal(0, 0.5), y, gaze[2] + rng.normal(0.1, 0.5))


def _stand_on_floor(build: Builder, x: float, y: float, z: float) -> None:
    """Add something that stands at (x, z) on a floor of height `y`."""
    rng, u, neutral = build.rng, build.rng.uniform, build.neutral
    match rng.choice(["leg", "shoe", "furniture", "bag", "stand", "small"], p=[0.2, 0.2, 0.25, 0.12, 0.08, 0.15]):
        case "leg":
            half = [u(0.015, 0.04), 0.4, 0.03]
            build.cylinder([x, y - 0.4, z], half, Finish("paint", neutral(0.01, 0.5), gloss=0.8))
        case "shoe":
            color, yaw = neutral(0.01, 0.5), u(-3, 3)
            for side in (-0.06, 0.06):
                center = [x + side * np.cos(yaw), y - 0.035, z - side * np.sin(yaw)]
                build.ball(center, [0.047, 0.045, 0.14], Finish("paint", color, gloss=0.5), yaw=yaw)
        case "furniture":
            half = u([0.15, 0.15, 0.15], [0.6, 0.45, 0.5])
            pattern = str(rng.choice(["panels", "cloth", "paint"]))
            first = build.wood() if rng.random() < 0.5 else neutral()
            finish = Finish(pattern, first, neutral(), u(0.1, 0.5))
            build.box([x + np.sign(x) * 0.3, y - half[1], z], half, finish, yaw=u(-0.4, 0.4))
        case "bag":
            half = u([0.1, 0.08, 0.1], [0.25, 0.18, 0.25])
            build.ball([x, y - 0.1, z], half, Finish("cloth", neutral(0.01, 0.4), neutral(), 0.2))
        case "stand":
            build.cylinder([x, y - 0.012, z], [0.14, 0.012, 0.14], Finish("paint", np.full(3, 0.4), gloss=2.0))
            build.cylinder([x, y - 0.7, z], [0.011, 0.7, 0.011], Finish("paint", np.full(3, 0.35), gloss=2.0))
        case "small":
            put_thing(build, x, y, z)


def _room(build: Builder, back: float) -> None:
    """A whole furnished room."""
    rng, u = build.rng, build.rng.uniform
    z, floor = back + u(1.2, 4.0), u(0.6, 1.45)
    left, right = -u(0.8, 3.0), u(0.8, 3.0)
    paint = build.wall_paint()
    build.box([0, 0, z + 0.05], [7, 4, 0.05], Finish("paint", paint))
    build.box([0, floor + 0.05, z / 2], [7, 0.05, 6], build.surface()._replace(gloss=u(0.2, 1.0)))
    build.box([0, floor - 2.5, z / 2], [7, 0.05, 6], Finish("paint", np.full(3, 0.75)))
    for x in (left, right):
        if rng.random() < 0.7:
            build.box([x + np.sign(x) * 0.05, 0, z / 2], [0.05, 4, 6], Finish("paint", paint * u(0.75, 1.0)))
    for _ in range(rng.integers(1, 4)):
        hang_on_wall(build, z, floor, 1.6)
    for _ in range(rng.integers(2, 6)):
        _furnish(build, u(left, right), floor, u(0.45, 0.95) * z)


def _furnish(build: Builder, x: float, floor: float, z: float) -> None:
    """Add a piece of furniture at (x, z)."""
    u, neutral = build.rng.uniform, build.neutral
    match build.rng.choice(["sofa", "table", "cabinet", "chair", "plant", "shelf"], p=[0.2, 0.2, 0.2, 0.15, 0.1, 0.15]):
        case "sofa":
            c = neutral(0.02, 0.6)
            build.box([x, floor - 0.22, z], [0.8, 0.22, 0.4], Finish("cloth", c, cell=0.6))
            build.box([x, floor - 0.55, z + 0.32], [0.8, 0.35, 0.1], Finish("cloth", c, cell=0.6))
            cushion = [x + u(-0.6, 0.6), floor - 0.55, z + 0.1]
            finish = Finish("cloth", neutral(), neutral(), 0.1)
            build.ball(cushion, [0.22, 0.2, 0.1], finish, yaw=u(-0.5, 0.5))
        case "table":
            c = build.wood()
            build.box([x, floor - 0.73, z], [u(0.3, 0.7), 0.02, 0.4], Finish("planks", c, gloss=0.6))
            for side in (-0.28, 0.28):
                build.box([x + side, floor - 0.36, z], [0.025, 0.36, 0.025], Finish("paint", c * 0.8))
            put_thing(build, x, floor - 0.75, z)
        case "cabinet":
            half = [u(0.3, 0.6), u(0.35, 0.9), 0.25]
            build.box([x, floor - 0.45, z], half, Finish("panels", build.wood(), cell=u(0.3, 0.6)))
        case "chair":
            c = neutral(0.01, 0.5)
            build.box([x, floor - 0.45, z], [0.22, 0.03, 0.22], Finish("cloth", c, cell=0.3))
            build.box([x, floor - 0.75, z + 0.2], [0.2, 0.25, 0.025], Finish("cloth", c, cell=0.3))
            build.cylinder([x, floor - 0.22, z], [0.03, 0.22, 0.03], Finish("paint", np.full(3, 0.1), gloss=1.0))
        case "plant":
            build.cylinder([x, floor - 0.15, z], [0.14, 0.15, 0.14], Finish("paint", neutral()))
            leaf, dark = np.array([0.06, 0.10, 0.04]), np.array([0.015, 0.025, 0.012])
            build.ball([x, floor - 0.7, z], [0.3, 0.45, 0.3], Finish("leaves", leaf, dark, 0.12))
        case "shelf":
            finish = Finish("books", build.wood(), cell=u(0.018, 0.035))
            build.box([x, floor - 0.9, z], [0.4, 0.9, 0.15], finish)


def _cloth(build: Builder, back: float) -> None:
    """A bed, a sofa, a lap."""
    rng, u = build.rng, build.rng.uniform
    gaze = build.axis_point(back + u(0.02, 0.25))
    y = max(gaze[1], 0.03)
    a = build.neutral(0.015, 0.7)
    second = np.clip(a * np.exp(rng.normal(0, 0.6)), 0.01, 0.8)
    finish = Finish("cloth", a, second, np.exp(u(np.log(0.02), np.log(0.6))))
    build.box([gaze[0], y + 0.15, gaze[2]], [1.5, 0.15, 1.2], finish)
    for _ in range(rng.integers(1, 4)):
        fold = [gaze[0] + rng.normal(0, 0.4), y + 0.03, gaze[2] + rng.normal(0, 0.3)]
        half = u([0.2, 0.03, 0.02], [0.6, 0.06, 0.07])
        build.ball(fold, half, Finish("cloth", a, cell=0.3), yaw=u(-3, 3))
    for _ in range(rng.integers(0, 4)):
        c, cushion = build.neutral(), [gaze[0] + rng.normal(0, 0.5), y - 0.04, gaze[2] + u(0.25, 0.8)]
        finish = Finish("cloth", c, build.neutral(), u(0.03, 0.3))
        build.ball(cushion, [0.3, 0.13, 0.22], finish, yaw=u(-3, 3))
    build.box([0, 0, gaze[2] + u(0.8, 2.5)], [6, 3, 0.05], Finish("paint", build.wall_paint()))


def _garden(build: Builder, back: float) -> None:
    """Sky, ground, and a few bushes, trunks and houses."""
    rng, u = build.rng, build.rng.uniform
    z, ground = back + u(3, 12), u(1.0, 1.5)
    build.box([0, -10, z + 20], [60, 40, 0.1], Finish("paint", np.array([0.5, 0.65, 0.9]), glow=u(0.6, 1.4)))
    leaf, dark = u(0.5, 1.2) * np.array([u(0.07, 0.16), u(0.11, 0.17), u(0.03, 0.07)]), np.array([0.018, 0.028, 0.012])
    if rng.random() < 0.4:  # a path
        finish = Finish("specks", build.neutral(), build.neutral(0.05, 0.4), u(0.03, 0.15))
    else:
        finish = Finish("leaves", leaf, dark, u(0.03, 0.15))
    build.box([0, ground + 0.05, z], [40, 0.05, 30], finish)
    for _ in range(rng.integers(3, 9)):
        x, at = rng.normal(0, 0.45) * z, u(0.4, 1.0) * z
        match rng.choice(["bush", "trunk", "house"], p=[0.6, 0.2, 0.2]):
            case "bush":
                half = u([0.4, 0.4, 0.4], [2.2, 1.8, 1.5])
                finish = Finish("leaves", leaf * u(0.6, 1.4), dark, u(0.1, 0.4))
                build.ball([x, ground - 0.7 * half[1], at], half, finish)
            case "trunk":
                bark = Finish("specks", np.array([0.1, 0.07, 0.05]), np.array([0.03, 0.02, 0.015]))
                build.cylinder([x, ground - 2, at], [u(0.05, 0.25), 2.2, 0.2], bark)
            case "house":
                half = [u(2, 5), 2.5, 2]
                finish = Finish("tiles", build.wall_paint(), np.full(3, 0.05), u(0.8, 1.6))
                build.box([x, ground - 2.5, z + 3], half, finish)


def _studio(build: Builder, back: float) -> None:
    """A plain backdrop close behind the hand."""
    rng, u = build.rng, build.rng.uniform
    colors = np.full(3, u(0.5, 0.88)), np.full(3, u(0.01, 0.1)), build.neutral(), build.vivid()
    color = colors[rng.choice(4, p=[0.4, 0.2, 0.28, 0.12])]
    z = build.axis_point(back + np.exp(u(np.log(0.02), np.log(0.8))))[2]
    build.box([0, 0, z + 0.05], [8, 8, 0.05], Finish("paint", color, gloss=0.1))


KINDS = {
    "wall": (0.24, _wall), "desk": (0.24, _desk), "floor": (0.13, _floor), "room": (0.20, _room),
    "cloth": (0.08, _cloth), "garden": (0.05, _garden), "studio": (0.06, _studio),
}  # fmt: skip
"""Share of the pictures, and the function that builds it."""


def list_backgrounds(folder: Path) -> tuple[Path, ...]:
    """The pictures of a folder, sorted by name. Each is opened once to check that it can be read.

    Raises:
        InputError: the folder does not exist or holds no pictures, or a picture cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of pictures, found none; give one that exists.")
    paths = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")))
    if not paths:
        raise InputError(
            f"{folder}: expected pictures ({', '.join(SUFFIXES[:4])} ...), found none; choose another folder."
        )
    for path in paths:
        read_photo(path, max_pixels=MAX_PIXELS)
    return paths


@functools.lru_cache(CACHED)
def _picture(path: Path) -> np.ndarray:
    """Linear RGB."""
    rgb = read_photo(path, max_pixels=MAX_PIXELS).rgb.numpy().astype(np.float32) / 255
    return np.where(rgb < 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def cut_background(paths: tuple[Path, ...], rng: np.random.Generator, size: int, blur: float) -> Float[Tensor, "H W 3"]:
    """A random square of a random picture, maybe mirrored, in linear light with mean 0.3; `blur` is in pixels."""
    picture = _picture(paths[rng.integers(len(paths))])
    height, width = picture.shape[:2]
    side = max(1, int(min(height, width) * rng.uniform(0.5, 1.0)))
    top, left = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
    cut = picture[top : top + side, left : left + side]
    if rng.random() < 0.5:
        cut = cut[:, ::-1]
    cut = cv2.resize(cut, (size, size), interpolation=cv2.INTER_AREA if side > size else cv2.INTER_LINEAR)
    cut = cv2.GaussianBlur(cut, (0, 0), max(blur, 0.3))
    return torch.from_numpy(np.ascontiguousarray(cut * (0.3 / max(float(cut.mean()), 0.02))))
