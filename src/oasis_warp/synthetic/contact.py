"""A grammar of gestures and grasps, and poses without self-collisions.

The grammar holds the states of fingers and thumb, and how much they vary. Angles are degrees: flexion is measured from
a straight finger, abduction from rest towards the thumb.

For collisions the hand is a set of balls, pushed apart by changing joint angles. Where one finger would penetrate
another or the palm, neighbours spread, fingers open and the thumb draws back until they only touch. Everything is
elementwise over a batch, so a pose does not depend on the others.
"""

import functools
import itertools
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from oasis_warp.core.hand_model import HandModel
from oasis_warp.synthetic.body import FINGERS, THUMB, Body, bundled_body

ALLOWED_OVERLAP = 1.0
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
    """Allowed penetration of each pair: that at rest plus `ALLOWED_OVERLAP` [mm], [P]."""


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
    allowed = np.maximum(-gap, 0) + ALLOWED_OVERLAP
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


FINGER_STATES = MappingProxyType({
    "straight": (0, 3, 2),
    "back": (-12, 2, 0),
    "soft": (12, 18, 10),
    "relaxed": (22, 28, 15),
    "half": (40, 48, 28),
    "bent": (58, 66, 38),
    "hooked": (6, 88, 52),
    "table": (72, 12, 6),
    "curled": (80, 98, 62),
})  # fmt: skip
"""Flexion of a finger's three joints."""
THUMBS = MappingProxyType({
    "out": (-10, 16, 0, 2, 0),
    "aside": (-2, 4, 0, 6, 4),
    "relaxed": (8, -4, 0, 14, 16),
    "up": (-12, 20, 0, 0, -6),
    "along": (10, -14, -8, 10, 8),
    "folded": (34, -2, -20, 34, 40),
    "fist": (30, 21, -20, 40, 48),
    "oppose": (32, 12, -11, 12, 14),
    "pinch": (35, 10, -10, 2, 5),
    "grasp": (22, 18, -12, 10, 22),
})  # fmt: skip
"""Flexion, abduction and twist of the base joint, then the flexion of the two outer joints."""
SPREAD = MappingProxyType({"index": 8.0, "middle": 1.5, "ring": -4.5, "little": -11.0})
"""Abduction of spread fingers."""


@dataclass(frozen=True)
class Gesture:
    """States of all fingers, and how they vary."""

    fingers: tuple[str, str, str, str]
    """States of index, middle, ring, little; "a>b" means a random mixture of two states."""
    thumb: str
    weight: float = 1.0
    spread: tuple[float, float] = (0.1, 1.0)
    """Range of the factor of `SPREAD`."""
    jitter: float = 1.0


_C = "curled"
_S = "straight"
GESTURES = MappingProxyType({
    "open": Gesture((_S, _S, _S, _S), "out", 4.0, (0.6, 1.5)),
    "stretched": Gesture(("back", "back", "back", "back"), "out", 1.0, (0.8, 1.7)),
    "flat": Gesture((_S, _S, _S, _S), "aside", 3.0, (-0.25, 0.1)),
    "thumb_across": Gesture((_S, _S, _S, _S), "folded", 1.5, (-0.2, 0.3)),
    "soft": Gesture(("soft", "soft", "soft>relaxed", "relaxed"), "relaxed", 4.0, (0.2, 1.0), 1.6),
    "relaxed": Gesture(("relaxed", "relaxed>half", "relaxed>half", "relaxed>half"), "relaxed", 3.0, (0.0, 0.8), 1.8),
    "fist": Gesture((_C, _C, _C, _C), "fist", 3.0, (0.0, 0.2)),
    "loose_fist": Gesture(("bent>curled", "bent>curled", "bent>curled", "bent>curled"), "grasp", 2.0, (0.0, 0.3)),
    "thumbs_up": Gesture((_C, _C, _C, _C), "up", 2.5, (0.0, 0.2)),
    "point": Gesture((_S, _C, _C, _C), "fist", 2.5, (0.0, 0.4)),
    "victory": Gesture((_S, _S, _C, _C), "fist", 2.5, (0.9, 2.0)),
    "two_together": Gesture((_S, _S, _C, _C), "fist", 1.5, (-0.2, 0.1)),
    "three": Gesture((_S, _S, _S, _C), "fist", 1.5, (0.5, 1.4)),
    "four": Gesture((_S, _S, _S, _S), "folded", 1.0, (0.5, 1.4)),
    "little_up": Gesture((_C, _C, _C, _S), "fist", 1.0, (0.0, 0.6)),
    "horns": Gesture((_S, _C, _C, _S), "fist", 1.0, (0.0, 0.8)),
    "love": Gesture((_S, _C, _C, _S), "out", 1.0, (0.0, 0.8)),
    "shaka": Gesture((_C, _C, _C, _S), "out", 1.5, (0.2, 1.2)),
    "l_shape": Gesture((_S, _C, _C, _C), "out", 1.5, (0.0, 0.6)),
    "gun": Gesture((_S, _S, _C, _C), "up", 1.0, (-0.2, 0.1)),
    "ok": Gesture(("half>bent", "soft", _S, _S), "oppose", 2.0, (0.2, 1.0)),
    "pinch": Gesture(("half>bent", "relaxed>half", "relaxed", "relaxed"), "pinch", 2.0, (0.0, 0.6)),
    "tripod": Gesture(("half", "half", "half>bent", "bent"), "pinch", 1.5, (-0.1, 0.3)),
    "key": Gesture(("bent", "bent", "bent>curled", "bent>curled"), "along", 1.0, (0.0, 0.2)),
    "cup": Gesture(("relaxed>half", "relaxed>half", "relaxed>half", "relaxed>half"), "grasp", 3.0, (-0.1, 0.5), 1.3),
    "ball": Gesture(("relaxed>half", "relaxed>half", "relaxed>half", "relaxed>half"), "grasp", 1.5, (0.8, 1.5), 1.2),
    "claw": Gesture(("hooked", "hooked", "hooked", "hooked"), "grasp", 1.0, (0.3, 1.3)),
    "hook": Gesture(("hooked", _C, _C, _C), "fist", 1.0, (0.0, 0.4)),
    "table": Gesture(("table", "table", "table", "table"), "relaxed", 1.0, (-0.1, 0.3)),
    "any": Gesture(("any", "any", "any", "any"), "any", 3.0, (-0.2, 1.4)),
})  # fmt: skip
"""By the names that every picture's ground truth uses."""
GESTURE_NAMES = tuple(GESTURES)
_WEIGHTS = np.array([gesture.weight for gesture in GESTURES.values()])


def _state(rng: np.random.Generator, words: str) -> np.ndarray:
    """Angles of a finger state or of a mixture of two."""
    if words == "any":
        low, high = rng.choice(list(FINGER_STATES), 2)
    else:
        low, _, high = words.partition(">")
    start, end = (np.array(FINGER_STATES[name or low], float) for name in (low, high))
    return start + (end - start) * rng.random()


def sample_gesture(rng: np.random.Generator, hand: HandModel) -> tuple[str, np.ndarray]:
    """A gesture's name and its angles [rad] about `hand.pose_axes`, 0 at rest, [16, 3], within the joint limits.

    Fingers may still penetrate each other; see `contact.separate`.
    """
    name = GESTURE_NAMES[rng.choice(len(_WEIGHTS), p=_WEIGHTS / _WEIGHTS.sum())]
    gesture = GESTURES[name]
    degrees = np.zeros((16, 3))
    spread = rng.uniform(*gesture.spread)
    follow = rng.normal(0, 1, 3)  # neighbouring fingers move alike
    for finger, words in zip(("index", "middle", "ring", "little"), gesture.fingers, strict=True):
        first = 3 * FINGERS.index(finger) + 1
        state = _state(rng, words)
        own = 0.75 * follow + 0.65 * rng.normal(0, 1, 3)
        degrees[first : first + 3, 0] = state + gesture.jitter * own * [5.0, 5.0, 3.0]
        closed = state[0] > 45  # the fingers of a fist cannot spread
        degrees[first, 1] = SPREAD[finger] * (0.15 if closed else spread) + rng.normal(0, 0.8 if closed else 2.0)
        degrees[first, 2] = rng.normal(0, 1.5)
    if gesture.thumb == "any":
        a, b = (np.array(THUMBS[t], float) for t in rng.choice(list(THUMBS), 2))
        thumb = a + (b - a) * rng.random()
    else:
        thumb = np.array(THUMBS[gesture.thumb], float)
    thumb = thumb + gesture.jitter * rng.normal(0, 1, 5) * [3.5, 3.5, 2.5, 4.5, 6.0]
    degrees[13] = thumb[:3]
    degrees[14, 0], degrees[15, 0] = thumb[3:]
    angles = np.radians(degrees)
    angles[:, 0] -= hand.rest_bend.double().numpy()
    low, high = hand.pose_limits.double().numpy().transpose(2, 0, 1)
    angles = np.clip(angles, low, high)
    angles[0] = 0
    return name, angles
