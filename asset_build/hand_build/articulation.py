"""How each joint turns, how far, and where on its bone each vertex lies."""

from typing import NamedTuple

import igl
import numpy as np

from hand_build.anatomy import FINGERS, FIRST, Array, Index, bone_ends, finger_chain, unit

# Anatomical ranges of flexion, abduction and twist [degrees]; 0 flexion is a straight finger, the thumb's base counts
# from rest. Clinical tables of flexion with some slack; the thumb's base, sideways play and twist are judgement.
FINGER_RANGES = (
    ((-25, 90), (-20, 20), (-8, 8)),
    ((-5, 110), (-4, 4), (-4, 4)),
    ((-10, 80), (-3, 3), (-3, 3)),
)
THUMB_RANGES = (
    ((-35, 45), (-40, 35), (-25, 35)),
    ((-15, 65), (-10, 10), (-10, 10)),
    ((-20, 85), (-5, 5), (-5, 5)),
)

NAIL_REACH = 0.02
"""A nail's faces are nearer to the tip of their finger than this [m]."""


class Labels(NamedTuple):
    """Where each vertex lies on the skeleton."""

    segment: Index
    """Joint with the largest weight."""
    side: Index
    """0 palm, 1 back, 2 flank."""
    bone_t: Array
    """Place along the bone of `segment`: 0 at the joint, 1 at the next."""
    bone_theta: Array
    """Angle of the normal about that bone [rad]: 0 back, +-pi palm."""


def pose_axes(vertices: Array, quads: Index, points: Array, nail_quads: Index) -> Array:
    """Unit axes of each joint at rest, [16, 3, 3]; rows flexion, abduction (also "to the back"), twist.

    A finger flexes in the plane of its nail's normal, which agrees with the plane of its joints within 10 to 15
    degrees and, unlike that, does not depend on how straight the finger is at rest.
    """
    axes = np.tile(np.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]]), (16, 1, 1))
    normals = np.cross(vertices[quads[:, 2]] - vertices[quads[:, 0]], vertices[quads[:, 3]] - vertices[quads[:, 1]])
    centres = vertices[quads].mean(1)
    for finger in FINGERS:
        chain = finger_chain(points, finger)
        on_nail = nail_quads & (np.linalg.norm(centres - chain[3], axis=1) < NAIL_REACH)
        across = unit(np.cross(unit(normals[on_nail].sum(0)), chain[3] - chain[2]))
        for i in range(3):
            along = unit(chain[i + 1] - chain[i])
            flexion = unit(across - (across @ along) * along)
            axes[FIRST[finger] + i] = np.stack([flexion, np.cross(along, flexion), along])
    return axes


def pose_limits(points: Array, axes: Array) -> tuple[Array, Array]:
    """Limits relative to rest [16, 3, 2] and the flexion that rest already has [16], in radians."""
    limits, bend = np.zeros((16, 3, 2)), np.zeros(16)
    limits[0] = [-np.pi, np.pi]
    for finger in FINGERS:
        bones = np.diff(np.vstack([points[0], finger_chain(points, finger)]), axis=0)
        for i, ranges in enumerate(THUMB_RANGES if finger == "thumb" else FINGER_RANGES):
            joint = FIRST[finger] + i
            axis = axes[joint, 0]
            before, after = (unit(bone - (bone @ axis) * axis) for bone in bones[i : i + 2])
            if (finger, i) != ("thumb", 0):
                bend[joint] = np.arctan2(np.cross(before, after) @ axis, before @ after)
            limits[joint] = np.radians(ranges)
            limits[joint, 0] -= bend[joint]
    return limits, bend


def labels(vertices: Array, faces: Index, points: Array, weights: Array, axes: Array) -> Labels:
    """Segment, side and bone coordinates of each vertex."""
    segment = weights.argmax(1)
    normals = igl.per_vertex_normals(vertices, faces)
    ends = bone_ends(points) | {0: points[FIRST["middle"]]}
    place, theta = np.zeros(len(vertices)), np.zeros(len(vertices))
    for joint, end in ends.items():
        on = segment == joint
        along = end - points[joint]
        place[on] = (vertices[on] - points[joint]) @ along / (along @ along)
        theta[on] = np.arctan2(normals[on] @ axes[joint, 0], normals[on] @ axes[joint, 1])
    turned = np.abs(theta)
    side = np.where(turned < np.radians(60), 1, np.where(turned > np.radians(120), 0, 2))
    return Labels(segment, side, place, theta)


def tip_vertices(vertices: Array, points: Array) -> Index:
    """The foremost vertex of each finger, thumb to little, [5]."""
    found = []
    for finger in FINGERS:
        chain = finger_chain(points, finger)
        ahead = vertices @ unit(chain[3] - chain[2])
        ahead[np.linalg.norm(vertices - chain[3], axis=1) > 0.015] = -np.inf
        found.append(int(ahead.argmax()))
    return np.array(found)
