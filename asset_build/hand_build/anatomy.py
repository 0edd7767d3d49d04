"""Names, order and measured numbers of a hand: what every step of the build shares."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FINGERS = ("thumb", "index", "middle", "ring", "little")
JOINTS = ("wrist", *(f"{f}{i}" for f in ("index", "middle", "little", "ring", "thumb") for i in (1, 2, 3)))
"""MANO's order."""
PARENTS = np.array([-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14])
LANDMARKS = np.array([0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20])
"""Rows of [16 joints | 5 tips, thumb to little] that are the 21 landmarks of the usual detectors, in their order."""

HAND_LENGTH = 0.190
"""Wrist joint to the tip of the middle finger [m]."""

FIRST = {finger: JOINTS.index(finger + "1") for finger in FINGERS}
"""Index of each finger's joint next to the palm."""


def unit(vectors: Array) -> Array:
    """The vectors along the last axis, scaled to length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def finger_chain(points: Array, finger: str) -> Array:
    """Three joints and the tip of `finger`, [4, 3], from the 21 points [joints | tips]."""
    first = FIRST[finger]
    return np.vstack([points[first : first + 3], points[16 + FINGERS.index(finger)]])


def bone_ends(points: Array) -> dict[int, Array]:
    """Where the bone of each joint but the wrist's ends: the next joint or the finger's tip."""
    return {FIRST[f] + i: finger_chain(points, f)[i + 1] for f in FINGERS for i in range(3)}




def descendants(joint: int) -> list[int]:
    """Joints that move when `joint` turns, itself left out."""
    found: list[int] = []
    for child in range(len(PARENTS)):
        if PARENTS[child] == joint or PARENTS[child] in found:
            found.append(child)
    return found
