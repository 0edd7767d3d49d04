"""Pose correctives: how far linear blend skinning is from a bent elastic finger, as shapes of the rest surface.

Blend skinning averages positions, which thins a bent joint and folds the palm side of a finger into itself. For
every joint and a few angles of flexion the surface is bent as flesh would be:

1. each vertex turns about the joint by its share of the angle, which keeps its distance from the joint;
2. the skin near the joint relaxes as an elastic surface, the palm side more freely than the back;
3. at the hinges of the fingers, the two sides of the crease press against each other and the flesh swells a little.

What blend skinning misses of that, carried back to rest, is fitted by two shapes a joint with strengths
c = 1 - cos(flexion) and c^2. To second order the shrinking of blend skinning goes with flexion^2, hence with c.
"""

from typing import NamedTuple

import igl
import numpy as np
from hand_build.anatomy import FINGERS, FIRST, PARENTS, Array, Index, bone_ends, descendants, unit
from hand_build.elastic import ElasticSurface, Fold

FLEXION_SHARES = (0.3, 0.55, 0.8, 1.0)
"""Of each joint's upper limit: the angles that the shapes are fitted to."""
REACH = 0.016
"""Along the bone, how far from a joint its palm side is soft [m]."""
FINGER_HALF_WIDTH = 0.014
HOLD_SOFT, HOLD_FIRM, HOLD_RIGID = 0.03, 4.0, 1e4
"""Pull to the bones, in units of cotangents, on soft, on firm and on untouched skin."""
BACK_SOFTNESS = 0.15
"""Of the skin on the back of a joint, which lies on bone, relative to the palm side's."""
SWELLING = 0.1
"""Share of the volume lost in a crease that comes back as a bulge. All of it would be a mushroom: real flesh gives way
along the whole finger."""
SMALLEST = 1e-5
"""Displacements below are dropped [m]."""


class RiggedSurface(NamedTuple):
    """The closed hand at rest with its skeleton."""

    vertices: Array
    faces: Index
    points: Array
    weights: Array
    axes: Array
    limits: Array


def strengths(flexion: Array) -> Array:
    """Strengths of a joint's two shapes at `flexion` [rad], [..., 2]. `oasis_warp.hand.correctives` does the same."""
    c = 1 - np.cos(flexion)
    return np.stack([c, c * c], -1)


def corrective_shapes(hand: RiggedSurface) -> Array:
    """Displacements of the rest surface at strength one, [V, 3, 30]: two for each joint from 1 to 15."""
    surface = ElasticSurface(hand.vertices, hand.faces)
    shapes = []
    for joint in range(1, len(PARENTS)):
        angles = hand.limits[joint, 0, 1] * np.array(FLEXION_SHARES)
        missed = np.stack([_missed_by_blending(hand, surface, joint, angle) for angle in angles])
        fitted, *_ = np.linalg.lstsq(strengths(angles), missed.reshape(len(angles), -1), rcond=None)
        shapes.extend(fitted.reshape(-1, *hand.vertices.shape))
    basis = np.stack(shapes, -1)
    basis[np.abs(basis) < SMALLEST] = 0
    return basis


def _missed_by_blending(hand: RiggedSurface, surface: ElasticSurface, joint: int, angle: float) -> Array:
    """Displacement of the rest surface whose blend skinning is the elastic surface, [V, 3]."""
    share = hand.weights[:, [joint, *descendants(joint)]].sum(1)
    centre, axis = hand.points[joint], hand.axes[joint, 0]
    bent = _bend(hand, surface, joint, angle, share)
    blend = (1 - share)[:, None, None] * np.eye(3) + share[:, None, None] * _rotation(axis, angle)
    return np.linalg.solve(blend, (bent - centre)[..., None])[..., 0] + centre - hand.vertices


def _bend(hand: RiggedSurface, surface: ElasticSurface, joint: int, angle: float, share: Array) -> Array:
    """The hand as flesh with one joint bent."""
    vertices, centre, axis = hand.vertices, hand.points[joint], hand.axes[joint, 0]
    turned = _turn(vertices, centre, axis, share * angle)
    before = unit(centre - hand.points[PARENTS[joint]])
    along = unit(before + unit(bone_ends(hand.points)[joint] - centre))
    along = unit(along - (along @ axis) * axis)
    offset = vertices - centre
    place, aside = offset @ along, np.abs(offset @ axis)

    palm_side = igl.per_vertex_normals(vertices, hand.faces) @ np.cross(axis, along)
    palm = np.clip((palm_side + 0.3) / 0.8, 0, 1)
    near = np.exp(-((place / REACH) ** 2))
    if PARENTS[joint] == 0:
        own = (aside < FINGER_HALF_WIDTH - 0.001).astype(float)
    else:
        own = np.clip((share + hand.weights[:, PARENTS[joint]] - 0.6) / 0.3, 0, 1)
    soft = palm * near * own * (np.linalg.norm(offset, axis=1) < 0.04)
    soft = np.maximum(soft, BACK_SOFTNESS * 4 * share * (1 - share))
    free = soft > 0.02
    hold = np.where(free, HOLD_SOFT + HOLD_FIRM * (1 - soft) ** 3, HOLD_RIGID)
    if joint in {FIRST[finger] for finger in FINGERS}:
        # No crease of one finger alone: its flesh is the palm's and the neighbours' too, and their shapes would add up.
        return surface.relax(turned, hold)

    normal = _rotation(axis, angle / 2) @ along
    creased = free & (aside < FINGER_HALF_WIDTH) & (np.linalg.norm(offset, axis=1) < 0.035)
    fold = Fold(centre, normal, np.sign(place) * creased, np.cross(axis, normal), depth=0.0015)
    lost = surface.volume(vertices) - surface.volume(turned)
    return surface.relax(
        turned, hold, fold=fold, swell=np.where(free, palm**2 * near, 0),
        volume=surface.volume(turned) + SWELLING * lost,
    )  # fmt: skip


def _turn(points: Array, centre: Array, axis: Array, angles: Array) -> Array:
    """Each point turned about the line through `centre` by its own angle."""
    offset = points - centre
    along = (offset @ axis)[:, None] * axis
    across = offset - along
    return centre + along + np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.cross(axis, across)


def _rotation(axis: Array, angle: float) -> Array:
    """Rotation matrix about a unit axis."""
    return _turn(np.eye(3), np.zeros(3), axis, np.full(3, angle)).T
