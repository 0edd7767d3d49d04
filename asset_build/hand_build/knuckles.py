"""Knuckles that stand out as joints bend, with hollows between them: the flesh of `elastic_hand` has no such bones.

Heights and depths were set by eye on the mesh of a fist seen from its back, by no photo of the tests.
"""

import itertools

import numpy as np

from hand_build.anatomy import Array
from oasis_warp.core.hand_model import HandModel
from oasis_warp.synthetic.body import FINGERS, finger_bones, knuckle_rise, rising

HIGHER = (2.1, 1.2, 1.0)
"""Height of each knuckle of a finger over what `knuckle_rise` gives it."""
ROW = ("index", "middle", "ring", "little")
VALLEY = 3.3
"""Depth between two knuckles of the row, when both fingers are bent by 90 degrees [mm]."""
WIDTH, LENGTH, TOWARDS_WRIST = 4.0, 14.0, 4.0
"""Half widths of a valley across and along the fingers, and how far its middle lies behind the joints [mm]."""


def knuckle_shapes(hand: HandModel, vertices: Array, normals: Array) -> Array:
    """Displacements [mm] of resting `vertices` [mm] for each corrective of `hand`, [30, n, 3].

    Correctives come in pairs for a joint: its first grows as 1 - cos(flexion), its second is left at 0.
    """
    bones = finger_bones(hand)
    height = knuckle_rise(vertices, normals, bones) * np.tile(HIGHER, len(FINGERS))
    for finger, other in itertools.pairwise(ROW):
        joints = [3 * FINGERS.index(name) for name in (finger, other)]
        first, second = (bones[FINGERS.index(name)][0] for name in (finger, other))
        middle = (first.origin + second.origin) / 2
        along = first.along + second.along
        along /= np.linalg.norm(along)
        back = first.back + second.back
        back -= along * (back @ along)
        back /= np.linalg.norm(back)
        to_middle = vertices - middle
        ahead, aside = to_middle @ along, to_middle @ np.cross(back, along)
        shape = np.exp(-((aside / WIDTH) ** 2) - ((ahead + TOWARDS_WRIST) / LENGTH) ** 2)
        depth = VALLEY * rising(normals @ back, 0.0, 0.6) * shape * (to_middle @ back > 0)
        height[:, joints] -= depth[:, None] / 2
    shapes = np.zeros((2 * height.shape[1], *vertices.shape))
    shapes[::2] = height.T[..., None] * normals
    return shapes
