"""Sample the camera's view and the light of one picture, with numpy.

In the camera's frame, which looks along +z with x right and y down; metres; colours are linear RGB.
"""

import functools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

N_LAMPS = 3
Vector = np.ndarray | Sequence[float | int]
PictureStyle = Literal["photo", "even"]
"""A photo with everything, or the bare hand in even light, as training needs its targets."""

_FACING = {
    "palm": np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]),
    "back": np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]),
    "thumb": np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, -1]]),
    "little": np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]),
}
"""Rotations from the hand's frame to a camera that sees this side of the hand, fingers up."""
_VIEW_SHARES = {"palm": 0.40, "back": 0.32, "thumb": 0.11, "little": 0.03, "any": 0.14}
_STILL = np.eye(3)
_TO_ELBOW = np.array([1.0, 0.0, 0.0])
"""Direction of a straight forearm in the hand's frame."""
_TURNED_ROUND = np.diag([-1.0, 1.0, -1.0])
ARM_CONE = np.radians(35)
"""Opening angle of the views along the forearm, from which it hides half of the hand on average [rad]."""
_TO_CAMERA = np.array([0.0, 0.0, -1.0])
DIRECTIONS = 400
"""Directions that sample the sky for its spherical harmonics."""


class Light(NamedTuple):
    """The light of one picture: sky and lamps."""

    sky: np.ndarray
    """Spherical harmonics of the radiance up to degree 2, [9, 3]."""
    directions: np.ndarray
    """Unit vectors from the hand to the lamps, [L, 3]."""
    distances: np.ndarray
    """[m], [L]."""
    colors: np.ndarray
    """Irradiance over pi at the hand, [L, 3]; black for no lamp."""
    spreads: np.ndarray
    """Radius over distance, [L]."""
    incident: np.ndarray
    """Approximate irradiance over pi on the hand, [3]; decides on exposure and white balance."""


class View(NamedTuple):
    """The pose of the hand relative to the camera."""

    rotation: np.ndarray
    """From the hand's frame to the camera's, [3, 3]."""
    distance: float
    """From the camera to the hand's middle [m]."""
    fill: float
    """Longer side of the hand's bounding box over the side of the picture."""
    shift: np.ndarray
    """Offset of the box's middle, over the side of the picture, [2]."""


def rotation_about(axis: Vector, angle: float) -> np.ndarray:
    """Rotation matrix (Rodrigues); the axis need not be a unit vector."""
    cross = _cross(*map(float, axis))
    return _STILL + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@functools.lru_cache(16)
def _cross(x: float, y: float, z: float) -> np.ndarray:
    """Matrix of the cross product with the unit vector along an axis; cached, since few axes occur."""
    x, y, z = np.array([x, y, z], float) / np.linalg.norm([x, y, z])
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def sample_view(rng: np.random.Generator, look: PictureStyle, closed: bool) -> View:
    """Sample a camera: mostly upright, of palm or back; from any side in even light.

    A `closed` hand shows its fingers rather than its back, as people hold up fists.
    """
    u = rng.uniform
    side = rng.choice(list(_VIEW_SHARES), p=list(_VIEW_SHARES.values()))
    quat = rng.normal(size=4)
    quat /= np.linalg.norm(quat)
    tilts = rng.normal(0, [0.42, 0.30, 0.36])
    sideways = rng.random()
    if closed and side == "back" and rng.random() < 0.65:
        side = "palm" if sideways < 0.4 else "thumb"
    if side == "any" or look == "even":
        w, x, y, z = quat
        rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
    else:
        roll = tilts[0] + (0 if sideways < 0.72 else rng.choice([-1.4, 1.4, 3.1], p=[0.45, 0.45, 0.1]))
        rotation = (
            rotation_about([0, 0, 1], roll)
            @ rotation_about([1, 0, 0], tilts[1])
            @ rotation_about([0, 1, 0], tilts[2])
            @ _FACING[side]
        )
    fill = u(0.45, 0.86) if look == "photo" else u(0.66, 0.86)
    return View(rotation, float(np.exp(u(np.log(0.32), np.log(0.85)))), fill, rng.normal(0, 0.05, 2))


def avoid_forearm(view: View, bend: np.ndarray) -> View:
    """The view, or the one from the opposite side if the forearm would hide the hand.

    Args:
        view: Any view.
        bend: Rotation vector of the forearm at the wrist [rad], [3].
    """
    arm = rotation_about(bend, float(np.linalg.norm(bend))) @ _TO_ELBOW
    if -(view.rotation @ arm)[2] < np.cos(ARM_CONE):
        return view
    return view._replace(rotation=_TURNED_ROUND @ view.rotation)


def warmth(t: float) -> np.ndarray:
    """Colour of light from bluish (negative) over white (0) to incandescent (1), with mean about 1."""
    return np.array([1.0, 1 - 0.18 * t, 1 - 0.42 * t]) / (1 - 0.16 * t)


def _harmonics(d: np.ndarray) -> np.ndarray:
    """Real spherical harmonics up to degree 2 at unit vectors, [n, 9]."""
    x, y, z = d.T
    return np.stack([
        0 * x + 0.2820948, 0.4886025 * y, 0.4886025 * z, 0.4886025 * x, 1.0925484 * x * y, 1.0925484 * y * z,
        0.3153916 * (3 * z * z - 1), 1.0925484 * x * z, 0.5462742 * (x * x - y * y),
    ], 1)  # fmt: skip


def sphere(n: int) -> np.ndarray:
    """Evenly spread unit vectors (Fibonacci spiral), [n, 3]."""
    k = np.arange(n) + 0.5
    z, longitude = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(longitude), r * np.sin(longitude), z], 1)


_SPHERE = sphere(DIRECTIONS)
_SPHERE_HARMONICS = _harmonics(_SPHERE) * (4 * np.pi / DIRECTIONS)


def rotate_light(light: Light, rotation: np.ndarray) -> Light:
    """The same light in another camera's frame; `rotation` maps the old frame to the new one."""
    spread = _harmonics(_SPHERE @ rotation) @ light.sky
    sky = np.linalg.lstsq(_harmonics(_SPHERE), spread, rcond=None)[0]  # exact: rotation keeps the degree
    return light._replace(sky=sky, directions=light.directions @ rotation.T)


def diffuse_light(light: Light, share: float) -> Light:
    """The same amount and colour of light: `share` of it keeps its directions, the rest is uniform."""
    sky = share * light.sky
    sky[0] = light.sky[0] + 0.65 * (1 - share) * light.colors.sum(0) / 0.2820948
    return light._replace(sky=sky, colors=share * light.colors)


@functools.cache
def _even_light() -> Light:
    d = _SPHERE
    level = 0.9 * np.ones((DIRECTIONS, 1)) - 0.12 * d[:, 1:2] - 0.18 * d[:, 2:3]
    sky = _SPHERE_HARMONICS.T @ (level * np.ones(3))
    none = np.zeros((N_LAMPS, 3))
    return Light(sky, none + _TO_CAMERA, np.ones(N_LAMPS), none, np.full(N_LAMPS, 0.1), np.ones(3))


def sample_light(rng: np.random.Generator, look: PictureStyle) -> Light:
    """Sample sky and soft lamps of a room, a window, the open air or a flash; a bright plain sky for "even"."""
    if look == "even":
        return _even_light()
    u, d = rng.uniform, _SPHERE
    up = np.array([rng.normal(0, 0.3), -1, rng.normal(0, 0.3)])
    up /= np.linalg.norm(up)
    mood = rng.normal(0.12, 0.3)
    if rng.random() < 0.15:  # a strongly coloured room: warm bulbs, red walls
        mood += u(0.4, 1.0)
    level = u(0.05, 0.26) * warmth(mood + rng.normal(0, 0.15)) * np.ones((DIRECTIONS, 1))
    level = level * (1 + u(0, 0.8) * d @ up)[:, None]
    below = d @ up < -0.2
    level[below] *= u(0.4, 1.1) * np.array([1.0, u(0.72, 0.95), u(0.45, 0.9)])  # what the floor throws back
    for _ in range(rng.integers(1, 4)):  # windows, lamps, bright walls
        c = rng.normal(size=3)
        c /= np.linalg.norm(c)
        lobe = np.exp((d @ c - 1) / u(0.03, 0.3))[:, None]
        level = level + lobe * u(0.3, 2.2) * warmth(mood + rng.normal(0, 0.25))
    behind = d[:, 2] > 0.25  # what stands behind the hand keeps light off and throws some back
    level[behind] = level[~behind].mean(0) * u(0.25, 0.6) * np.exp(rng.normal(0, 0.12, 3))
    sky = _SPHERE_HARMONICS.T @ level

    n = int(rng.choice([1, 2, 3], p=[0.55, 0.33, 0.12]))
    directions, colors = np.zeros((N_LAMPS, 3)) + _TO_CAMERA, np.zeros((N_LAMPS, 3))
    distances, spreads = np.ones(N_LAMPS), np.full(N_LAMPS, 0.1)
    for k in range(n):
        if k == 0 and rng.random() < 0.13:  # the camera's own flash
            way, spread, distance = np.array([rng.normal(0, 0.12), -0.08, -1]), u(0.02, 0.05), u(0.4, 0.9)
        else:
            way = up * u(0.1, 1.2) + rng.normal(0, 0.7, 3) + [0, 0, -0.35]
            way[2] = min(way[2], -0.1 - 0.3 * abs(rng.normal()))
            spread, distance = float(np.exp(u(np.log(0.04), np.log(0.42)))), float(np.exp(u(np.log(0.5), np.log(4.0))))
        directions[k], distances[k], spreads[k] = way / np.linalg.norm(way), distance, spread
        colors[k] = u(0.5, 1.9) / (1 + k) * warmth(mood + rng.normal(0.03, 0.2))
    return Light(sky, directions, distances, colors, spreads, 0.2820948 * sky[0] + 0.65 * colors.sum(0))
