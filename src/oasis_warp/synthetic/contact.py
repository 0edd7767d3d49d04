"""Resolve self-collisions: the hand as a set of balls, pushed apart by changing joint angles.

Where one finger would penetrate another or the palm, neighbours spread, fingers open and the thumb draws back until
they only touch. Everything is elementwise over a batch, so a pose does not depend on the others.
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np

from oasis_warp.synthetic.body import FINGERS, THUMB, Body, bundled_body

FLESH = 1.0
"""Penetration that soft tissue allows [mm]."""
ROUNDS = 22
_PLACES = (0.12, 0.37, 0.63, 0.88)
"""Positions of the balls along a bone, as shares of its length."""
_OPEN_THUMB = np.radians([-10.0, 16.0, 0.0])
PALM = 5
"""The group number of the palm's balls; those of the fingers come first."""
_ORDER = ("index", "middle", "ring", "little")


class Balls(NamedTuple):
    """The hand as balls, in millimetres at rest."""

    joint: np.ndarray
    """Bone that carries each, [N]."""
    center: np.ndarray
    radius: np.ndarray
    group: np.ndarray
    """Finger, or PALM."""
    pairs: np.ndarray
    """Balls that may collide, [P, 2]; sorted by their groups."""
    starts: np.ndarray
    """First pair of each two groups that may collide."""
    column: np.ndarray
    """Index into `starts` for two groups, [6, 6]."""
    allowed: np.ndarray
    """Allowed penetration of each pair: that at rest plus `FLESH` [mm], [P]."""


@functools.cache
def bundled_balls() -> Balls:
    """The balls of the mean hand."""
    body = bundled_body()
    rows = []
    for finger in range(5):
        for place in range(3):
            for share, (c, r) in zip(_PLACES, _sections(body, finger, place), strict=True):
                if place == 2 and share == _PLACES[-1]:
                    r = 0.9 * r
                rows.append((3 * finger + 1 + place, c, r, finger))
    knuckles = body.hand.joints[[1, 4, 10, 7]].double().numpy() * 1e3
    for knuckle in knuckles:
        for share in (0.25, 0.45, 0.65, 0.85):
            c = knuckle * share
            near = body.rest[: body.n_hand].double().numpy() - c
            off = np.hypot(near[:, 0], near[:, 2]) < 5
            c = c + np.array([0, (near[off, 1].max() + near[off, 1].min()) / 2, 0])
            thick = np.ptp(near[off, 1]) / 2
            rows.append((0, c, min(thick, 13.0), PALM))
    joint, center, radius, group = (np.array(column) for column in zip(*rows, strict=True))
    i, j = np.triu_indices(len(joint), 1)
    outer = lambda k: (joint[k] == 0) | ((joint[k] - 1) % 3 > 0)  # noqa: E731  (first phalanges touch at their roots)
    palm_pair = (group[i] == PALM) ^ (group[j] == PALM)
    meet = (group[i] != group[j]) & ~((group[i] == PALM) & (group[j] == PALM))
    meet &= ~palm_pair | (outer(i) & outer(j))
    pairs = np.stack([i[meet], j[meet]], 1)
    gap = np.linalg.norm(center[pairs[:, 0]] - center[pairs[:, 1]], axis=1) - radius[pairs].sum(1)
    groups = np.sort(group[pairs], 1)
    order = np.lexsort((groups[:, 1], groups[:, 0]))
    kinds, starts = np.unique(groups[order], axis=0, return_index=True)
    column = np.zeros((6, 6), int)
    column[kinds[:, 0], kinds[:, 1]] = column[kinds[:, 1], kinds[:, 0]] = np.arange(len(kinds))
    allowed = np.maximum(-gap, 0) + FLESH
    return Balls(joint, center, radius, group, pairs[order], starts, column, allowed[order])


def _sections(body: Body, finger: int, place: int) -> list[tuple[np.ndarray, float]]:
    """Centre and radius of cross-sections of a bone's surface."""
    bone = body.bones[finger][place]
    hand = body.hand
    of_bone = hand.weights[:, 3 * finger + 1 + place].numpy() > 0.4
    local = bone.local(body.rest[: body.n_hand].double().numpy()[of_bone])
    out = []
    for share in _PLACES:
        near = local[np.argsort(np.abs(local[:, 0] - share * bone.length))[:40]]
        side, back = ((near[:, k].max() + near[:, k].min()) / 2 for k in (1, 2))
        radius = min(np.ptp(near[:, 1]), np.ptp(near[:, 2])) / 2
        out.append(
            (bone.origin + bone.along * share * bone.length + bone.side * side + bone.back * back, min(radius, 12.0))
        )
    return out


class Skeleton:
    """Forward kinematics of a batch of hands in float64, elementwise over the batch."""

    def __init__(self, body: Body):
        hand = body.hand
        self.parents = hand.parents
        axes = hand.pose_axes.double().numpy()
        x, y, z = axes[..., 0], axes[..., 1], axes[..., 2]
        zero = np.zeros_like(x)
        self._cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(16, 3, 3, 3)
        self._square = self._cross @ self._cross

    def transforms(self, angles: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotation [B, 16, 3, 3] and translation [B, 16, 3] from rest to pose of each bone, with the wrist fixed.

        Args:
            angles: About the pose axes [rad], [B, 16, 3].
            joints: At rest, [B, 16, 3], any unit.
        """
        a = angles[..., None, None]
        about = np.eye(3) + np.sin(a) * self._cross + (1 - np.cos(a)) * self._square
        local = about[:, :, 0] @ about[:, :, 1] @ about[:, :, 2]
        rotation, origin = [np.broadcast_to(np.eye(3), (len(angles), 3, 3))], [joints[:, 0]]
        for j in range(1, 16):
            parent = self.parents[j]
            rotation.append(rotation[parent] @ local[:, j])
            step = joints[:, j] - joints[:, parent]
            origin.append((rotation[parent] @ step[..., None])[..., 0] + origin[parent])
        rotations = np.stack(rotation, 1)
        return rotations, np.stack(origin, 1) - (rotations @ joints[..., None])[..., 0]


@functools.cache
def bundled_skeleton() -> Skeleton:
    """The kinematics of the bundled hand."""
    return Skeleton(bundled_body())


def overlaps(angles: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Penetration of each pair of balls beyond what is allowed [mm], [B, P]; `joints` are in mm, [B, 16, 3]."""
    balls = bundled_balls()
    rest = bundled_body().hand.joints.double().numpy() * 1e3
    rotation, shift = bundled_skeleton().transforms(angles, joints)
    # A longer bone carries its balls further out.
    place = balls.center - rest[balls.joint] + joints[:, balls.joint]
    posed = (rotation[:, balls.joint] @ place[..., None])[..., 0] + shift[:, balls.joint]
    i, j = balls.pairs.T
    x, y, z = (along.take(i, 1) - along.take(j, 1) for along in posed.transpose(2, 0, 1))
    distance = np.sqrt(x * x + y * y + z * z)
    return np.maximum(balls.radius[i] + balls.radius[j] - distance - balls.allowed, 0)


def separate(angles: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles near `angles` without penetration, and the largest penetration that remains [mm], [B].

    Args:
        angles: Within the joints' limits [rad], [B, 16, 3].
        joints: At rest [mm], [B, 16, 3].
    """
    best, best_depth = angles.copy(), np.full(len(angles), np.inf)
    active, current = np.arange(len(angles)), angles
    for _ in range(ROUNDS + 1):
        depth = overlaps(current, joints[active])
        deepest = depth.max(1)
        better = deepest < best_depth[active]
        best[active[better]], best_depth[active[better]] = current[better], deepest[better]
        on = deepest > 0
        if not on.any():
            break
        active, current = active[on], _eased(current[on], depth[on])
    return best, best_depth


def _eased(angles: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """One step that reduces penetration: neighbours spread, fingers open, the thumb draws back."""
    balls, hand = bundled_balls(), bundled_body().hand
    rest_bend = hand.rest_bend.double().numpy()
    angles, between = angles.copy(), np.maximum.reduceat(depth, balls.starts, axis=1)

    def worst(a: int, b: int) -> np.ndarray:
        return between[:, balls.column[a, b]]

    for a, b in itertools.pairwise(_ORDER):
        push = np.radians(np.minimum(0.6 * worst(FINGERS.index(a), FINGERS.index(b)), 2.0))
        angles[:, 3 * FINGERS.index(a) + 1, 1] += push
        angles[:, 3 * FINGERS.index(b) + 1, 1] -= push
    for name in _ORDER:
        finger = FINGERS.index(name)
        ease = np.minimum(0.012 * worst(finger, PALM), 0.06)[:, None]
        rows = slice(3 * finger + 1, 3 * finger + 4)
        flexion = angles[:, rows, 0] + rest_bend[rows]
        angles[:, rows, 0] -= ease * np.maximum(flexion, 0)
    blocked = np.max([worst(THUMB, k) for k in (0, 1, 2, 3, PALM)], 0)
    back = np.minimum(0.022 * blocked, 0.10)[:, None]
    angles[:, 13] += back * (_OPEN_THUMB - angles[:, 13])
    angles[:, 14:16, 0] -= back * np.maximum(angles[:, 14:16, 0], 0)
    low, high = hand.pose_limits.double().numpy().transpose(2, 0, 1)
    return np.clip(angles, low, high)
