"""A grammar of gestures and grasps: the states of fingers and thumb, and how much they vary.

Angles are degrees: flexion is measured from a straight finger, abduction from rest towards the thumb.
"""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from oasis_warp.core.hand_model import HandModel
from oasis_warp.synthetic.body import FINGERS

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
