"""The lines of fingers, wrist and back: creases, folds over the knuckles, veins, tendons and hairs."""

import numpy as np

from oasis_warp.synthetic.atlas import Atlas
from oasis_warp.synthetic.body import FINGERS, Bone
from oasis_warp.synthetic.identity import Identity
from oasis_warp.synthetic.strokes import Strokes

THUMB = FINGERS.index("thumb")
_KNUCKLES = (1, 4, 7, 10)
"""First joints of the four fingers."""
_CREASES = {1: (-1.8, 1.4), 2: (0.3,)}
"""Places of the flexion creases along the bone before joints 1 and 2 of a finger [mm]."""
_THUMB_CREASES = {0: (), 1: (1.0,), 2: (-1.1, 1.3)}


def draw_fingers(atlas: Atlas, strokes: Strokes, identity: Identity) -> None:
    """Flexion creases on the palm's side, folds over the joints on the back."""
    for finger, name in enumerate(FINGERS):
        for place in range(3):
            bone = atlas.body.bones[finger][place]
            _creases(atlas, strokes, identity, name, place, bone)
            if place > 0:
                _folds(atlas, strokes, identity, name, place, bone)


def _arc(atlas: Atlas, name: str, bone: Bone, t: float, angles: np.ndarray, radius: float, bow: float) -> np.ndarray:
    """Points of a finger around its bone at `t` [mm]; angle 0 is the back, `bow` bends the arc along the bone."""
    around = np.cos(angles)[:, None] * bone.back + np.sin(angles)[:, None] * bone.side
    middle = angles - angles.mean()
    return atlas.snap(bone.origin + bone.along * (t + bow * middle**2)[:, None] + radius * around, name)


def _creases(atlas: Atlas, strokes: Strokes, identity: Identity, name: str, place: int, bone: Bone) -> None:
    rng, thumb = strokes.rng, name == "thumb"
    u = rng.uniform
    if place == 0 and not thumb:
        for t in (bone.length * 0.52, bone.length * 0.52 + 2.5)[: 1 + (rng.random() < 0.7)]:
            angles = np.pi + np.linspace(-1.6, 1.6, 30)
            strokes.add("crease", _arc(atlas, name, bone, t + rng.normal(0, 0.7), angles, 10.0, rng.normal(0, 0.15)),
                        u(0.45, 0.65), u(0.5, 0.95), taper=0.3)  # fmt: skip
        return
    places = _THUMB_CREASES[place] if thumb else _CREASES[place]
    for t in places[: len(places) - (rng.random() < 0.15 and len(places) > 1)]:
        span = u(1.5, 2.0)
        angles = np.pi + rng.normal(0, 0.08) + np.linspace(-span, span, 30) * u(0.85, 1)
        line = _arc(atlas, name, bone, t + rng.normal(0, 0.5), angles, 9.0, rng.normal(0, 0.15))
        strokes.add("crease", line, u(0.4, 0.62), u(0.7, 1.15) * (0.8 if place == 2 else 1), taper=0.3)
    for _ in range(rng.integers(2, 6) + int(5 * identity.line_wealth)):
        middle, half = np.pi + rng.normal(0, 0.7), u(0.25, 0.7)
        line = _arc(atlas, name, bone, rng.normal(0, 3.2), np.linspace(middle - half, middle + half, 14), 9.0,
                    rng.normal(0, 0.3))  # fmt: skip
        strokes.add("crease", line, u(0.28, 0.42), u(0.15, 0.45), taper=0.5)
    for _ in range(int(rng.integers(2, 5) + 6 * identity.line_wealth)):  # lengthwise lines of the pads
        a, t0 = np.pi + rng.normal(0, 0.55), u(0.15, 0.75) * bone.length
        steps = np.linspace(0, u(3, 9), 10)
        around = np.cos(a) * bone.back + np.sin(a) * bone.side
        line = atlas.snap(bone.origin + bone.along * (t0 + steps)[:, None] + 9 * around, name)
        strokes.add("minor", line, u(0.26, 0.4), u(0.15, 0.4), taper=0.5)


def _folds(atlas: Atlas, strokes: Strokes, identity: Identity, name: str, place: int, bone: Bone) -> None:
    """An eye of arcs that bend away from the joint, and broken wrinkles between them."""
    rng, thumb = strokes.rng, name == "thumb"
    u = rng.uniform
    count = ({1: 4, 2: 8} if thumb else {1: 9, 2: 5})[place] + rng.integers(-1, 2)
    reach = 5.0 if place == 1 or thumb else 2.6
    depth = identity.knuckles * (1 if place == 1 else 0.55)
    for t in np.linspace(-1, 1, count):
        half, middle = u(0.4, 0.8) * (1.2 - 0.1 * abs(t)), rng.normal(0, 0.14)
        angles = np.linspace(middle - half, middle + half, 16)
        line = _arc(atlas, name, bone, t * reach + rng.normal(0, 0.4) - (place == 1), angles, 8.0,
                    -0.9 * np.sign(t) * abs(t) + rng.normal(0, 0.3))  # fmt: skip
        strokes.add("fold", line, u(0.45, 0.75), u(0.7, 1.6) * depth, taper=0.4, wobble=0.4)
    for _ in range(int(3 + 8 * identity.age)):
        middle, half = rng.normal(0, 0.4), u(0.15, 0.4)
        line = _arc(
            atlas, name, bone, rng.normal(0, reach * 0.8), np.linspace(middle - half, middle + half, 10), 8.0, 0.0
        )
        strokes.add("fold", line, u(0.35, 0.5), u(0.3, 0.8) * depth, taper=0.5, wobble=0.5)


def draw_wrist(atlas: Atlas, strokes: Strokes) -> None:
    """One to three lines across the inner side of the wrist."""
    rng = strokes.rng
    for x in (1.0, 5.5, 11.0)[: rng.integers(1, 4)]:
        z = np.linspace(-26, 26, 40)
        line = np.c_[x + rng.normal(0, 1) - rng.uniform(0.002, 0.006) * z**2, 0 * z, z]
        strokes.add("crease", atlas.snap(line, "wrist"), 0.7, rng.uniform(0.3, 0.9), taper=0.2, wobble=0.7)


def draw_back(atlas: Atlas, strokes: Strokes, identity: Identity) -> None:
    """Tendons to the knuckles, veins as random walks towards the wrist, hairs, fine cross lines."""
    rng = strokes.rng
    knuckles = atlas.body.hand.joints[list(_KNUCKLES)].double().numpy() * 1e3
    for knuckle in knuckles:
        t = np.linspace(0, 1, 40)[:, None]
        line = knuckle * [1, 0, 1] * (1 - t) + t * np.array([4, 0, 2 + 0.2 * knuckle[2]])
        strokes.add("tendon", atlas.snap(line, "back"), 2.6, 1.0, taper=0.35, wobble=0.6)
    for _ in range(rng.integers(5, 10)):
        at, heading = np.array([-rng.uniform(55, 88), 0, rng.uniform(-34, 22)]), rng.normal(0, 0.4)
        walk = [at]
        for _ in range(rng.integers(20, 60)):
            heading = 0.9 * heading + rng.normal(0, 0.16) - 0.002 * walk[-1][2]
            walk.append(walk[-1] + 2.5 * np.array([np.cos(heading), 0, np.sin(heading)]))
        strokes.add("vein", atlas.snap(np.array(walk), "back"), rng.uniform(1.1, 1.9), rng.uniform(0.4, 1))
    for _ in range(int(20 + 60 * identity.age)):  # the back's skin wrinkles across the hand
        middle, half = np.array([rng.uniform(-85, 0), 0, rng.uniform(-36, 26)]), rng.uniform(2, 8)
        slope = rng.normal(0, 0.5)
        t = np.linspace(-half, half, 10)[:, None]
        strokes.add("fold", atlas.snap(middle + t * [slope, 0, 1], "back"), 0.5, rng.uniform(0.06, 0.28), taper=0.5)
    _hairs(atlas, strokes, identity, knuckles)


def _hairs(atlas: Atlas, strokes: Strokes, identity: Identity, knuckles: np.ndarray) -> None:
    """Bent hairs that lean towards the little finger's side, on the arm, the back and the first phalanges."""
    rng, n = strokes.rng, identity.hairs
    if not n:
        return
    on_finger = rng.random(n) > 0.86
    roots = np.c_[rng.uniform(-72, 260, n), np.zeros(n), rng.normal(-8, 24, n)]
    roots[on_finger] = (
        knuckles[rng.integers(4, size=on_finger.sum())] + [-20, 0, 0] + rng.normal(0, 3, (on_finger.sum(), 3))
    )
    lean, curl, length = rng.normal(-1.0, 0.35, n), rng.normal(0, 0.12, n), rng.uniform(3, 11, n)
    t = np.linspace(0, 1, 9)
    turn = lean[:, None] + curl[:, None] * t * length[:, None] * 0.35
    steps = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], -1) * (length[:, None] / 8)[..., None]
    lines = atlas.snap((roots[:, None] + np.cumsum(steps, 1)).reshape(-1, 3), "back").reshape(n, 9, 3)
    for line, root in zip(lines, roots, strict=True):
        if np.abs(line[0] - root)[[0, 2]].max() < 4:  # not one that fell beside the arm
            strokes.add("hair", line, 0.27, rng.uniform(0.35, 0.75), taper=0.4, wobble=0.08)
