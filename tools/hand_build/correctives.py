"""Pose correctives: how far linear blend skinning is from a bent elastic finger, as shapes of the rest surface.

Blend skinning averages positions, which thins a bent joint and folds the palm side of a finger into itself. For
every joint and a few angles of flexion the surface is bent as flesh would be:

1. each vertex turns about the joint by its share of the angle, which keeps its distance from the joint;
2. the skin near the joint relaxes as an elastic surface, the palm side more freely than the back, and swells a little
   where flesh is squeezed;
3. at the outer joints the two sides of the crease press against each other.

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
UNTOUCHED = 0.02
"""Softness below which skin moves with its bones alone."""
HINGE_SWELLING, BASE_SWELLING = 0.1, 0.3
"""Share of the lost volume that comes back as a bulge near the joint. All of it would be a mushroom, for real flesh
gives way along the whole finger; judged by pictures."""
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
    """The hand as flesh with one joint bent; `share` [V] of the angle is what each vertex turns by."""
    turned = _turn(hand.vertices, hand.points[joint], hand.axes[joint, 0], share * angle)
    settle = _settle_base if joint in {FIRST[finger] for finger in FINGERS} else _settle_hinge
    return settle(hand, surface, joint, angle, share, turned)


def _settle_base(
    hand: RiggedSurface, surface: ElasticSurface, joint: int, angle: float, share: Array, turned: Array
) -> Array:
    """Knuckles and the thumb's base: soft wherever palm and finger share the skin.

    There is no crease of one finger alone, for its flesh is the palm's and the neighbours' too, and their shapes add
    up. What is squeezed between finger and palm bulges: the ball of the thumb, the pads below the fingers.
    """
    axis = hand.axes[joint, 0]
    along = unit(bone_ends(hand.points)[joint] - hand.points[joint])
    palm = _facing(turned, hand.faces, np.cross(axis, _rotation(axis, angle / 2) @ along))
    shared = 4 * share * (1 - share)
    free = shared > UNTOUCHED
    return surface.relax(
        turned, _hold(np.maximum(palm, BACK_SOFTNESS) * shared, free), swell=np.where(free, palm * shared, 0),
        volume=_swollen(hand, surface, turned, BASE_SWELLING),
    )  # fmt: skip


def _settle_hinge(
    hand: RiggedSurface, surface: ElasticSurface, joint: int, angle: float, share: Array, turned: Array
) -> Array:
    """The outer joints: soft on the palm side, where the two sides of a crease press against each other."""
    centre, axis = hand.points[joint], hand.axes[joint, 0]
    before = unit(centre - hand.points[PARENTS[joint]])
    along = unit(before + unit(bone_ends(hand.points)[joint] - centre))
    along = unit(along - (along @ axis) * axis)
    offset = hand.vertices - centre
    place = offset @ along
    distance = np.linalg.norm(offset, axis=1)

    palm = _facing(hand.vertices, hand.faces, np.cross(axis, along))
    near = np.exp(-((place / REACH) ** 2))
    own = np.clip((share + hand.weights[:, PARENTS[joint]] - 0.6) / 0.3, 0, 1)
    soft = np.maximum(palm * near * own * (distance < 0.04), BACK_SOFTNESS * 4 * share * (1 - share))
    free = soft > UNTOUCHED
    normal = _rotation(axis, angle / 2) @ along
    creased = free & (np.abs(offset @ axis) < FINGER_HALF_WIDTH) & (distance < 0.035)
    return surface.relax(
        turned, _hold(soft, free), fold=Fold(centre, normal, np.sign(place) * creased, np.cross(axis, normal), 0.0015),
        swell=np.where(free, palm**2 * near, 0), volume=_swollen(hand, surface, turned, HINGE_SWELLING),
    )  # fmt: skip


def _facing(vertices: Array, faces: Index, way: Array) -> Array:
    """1 where the surface faces `way`, 0 where it faces away, [V]."""
    return np.clip((igl.per_vertex_normals(vertices, faces) @ way + 0.3) / 0.8, 0, 1)


def _hold(soft: Array, free: Array) -> Array:
    """How firmly each vertex is held to the bones, from its softness in 0 to 1."""
    return np.where(free, HOLD_SOFT + HOLD_FIRM * (1 - soft) ** 3, HOLD_RIGID)


def _swollen(hand: RiggedSurface, surface: ElasticSurface, turned: Array, share: float) -> float:
    """The volume [m^3] once `share` of what the bend has lost is back."""
    now = surface.volume(turned)
    return now + share * (surface.volume(hand.vertices) - now)


def _turn(points: Array, centre: Array, axis: Array, angles: Array) -> Array:
    """Each point turned about the line through `centre` by its own angle."""
    offset = points - centre
    along = (offset @ axis)[:, None] * axis
    across = offset - along
    return centre + along + np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.cross(axis, across)


def _rotation(axis: Array, angle: float) -> Array:
    """Rotation matrix about a unit axis."""
    return _turn(np.eye(3), np.zeros(3), axis, np.full(3, angle)).T
