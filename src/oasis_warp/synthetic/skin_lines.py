"""The lines of a hand's skin: creases, folds over the knuckles, veins, tendons, hairs, and the lines of the palm.

Lines are collected with their random numbers; `texels.draw_lines` draws them all at once. This module needs no device,
so that processes that plan people can import it.
"""

from typing import NamedTuple

import numpy as np

from oasis_warp.synthetic.atlas import Atlas
from oasis_warp.synthetic.body import FINGERS, Bone
from oasis_warp.synthetic.identity import Identity

KINDS = ("crease", "main", "minor", "fold", "wrinkle", "vein", "tendon", "hair", "halo")
"""Flexion creases of the fingers and wrist; the palm's main and its fine lines; folds over the knuckles; compression
wrinkles; vessels; tendons; hairs; the soft valley along main lines."""
_LONG = ("crease", "main", "halo")
_SPACING = 0.25
_HAIR_SPACING = 0.14
"""Distance between the samples of a line, and of a hair [mm]."""
PLACE_CELL, STRENGTH_CELL = 5.0, 4.0
"""Distance between the random values of a line's position and width, and of its strength [mm]."""
_WALKS = 5
"""Random walks of one line: three of its position, one of its strength, one of its width."""
LINE_WORDS, CORNER_WORDS = 15, 4
"""Numbers in `Lines` for each line and for each of its corners."""
_KNUCKLES = (1, 4, 7, 10)
"""First joints of index, middle, little and ring finger."""
_CREASES = {1: (-1.8, 1.4), 2: (0.3,)}
"""Positions of the flexion creases along bones 1 and 2 of a finger [mm]."""
_THUMB_CREASES = {0: (), 1: (1.0,), 2: (-1.1, 1.3)}
SINGLE_CREASE = 0.05
"""Share of people whose head and heart lines are one."""


class Lines(NamedTuple):
    """Lines in one array, which is copied to the device at once."""

    numbers: np.ndarray
    """float64. First `n_lines` rows: the fields of `_Line`, the number of samples, the sums over all lines before of
    samples, corners, lengths + 1 and knots, and the amplitude of the strength's walk. Then `n_corners` rows: x, y, z,
    distance from the line's start. Then the knots of the random walks, line after line."""
    n_lines: int
    n_corners: int
    n_samples: int


class _Line(NamedTuple):
    """Numbers of one line."""

    corners: int
    length: float
    width: float
    strength: float
    taper: float
    wobble: float
    kind: int
    place_knots: int
    """Random values of each walk except the strength's."""
    strength_knots: int


class Strokes:
    """A collection of lines; lengths in millimetres."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self._lines: list[_Line] = []
        self._corners: list[np.ndarray] = []
        self._knots: list[np.ndarray] = []

    def add(self, kind: str, points: np.ndarray, width: float, strength: float, *, taper: float = 0.25,
            wobble: float = 0.3) -> None:  # fmt: skip
        """Add a line through `points` [n, 3].

        Args:
            kind: One of `KINDS`.
            points: On the surface, in order.
            width: Width of the Gaussian profile.
            strength: Strength in the middle; it varies by up to a quarter, that of fine lines by up to a half.
            taper: Share of the length over which each end fades.
            wobble: Amplitude of the random walk of the position.
        """
        steps = points[1:] - points[:-1]
        corners = np.empty((len(points), CORNER_WORDS))
        corners[:, :3] = points
        corners[0, 3] = 0
        np.cumsum(np.sqrt((steps * steps).sum(1)), out=corners[1:, 3])
        length = float(corners[-1, 3])
        if length < 1e-6:
            return
        place_knots, strength_knots = (int(np.ceil(length / cell + 3)) for cell in (PLACE_CELL, STRENGTH_CELL))
        self._knots.append(self.rng.uniform(-1, 1, (_WALKS - 1) * place_knots + strength_knots))
        self._corners.append(corners)
        self._lines.append(
            _Line(len(points), length, width, strength, taper, wobble, KINDS.index(kind), place_knots, strength_knots)
        )

    def lines(self) -> Lines:
        """All lines so far."""
        table = np.array(self._lines, float).reshape(-1, len(_Line._fields))
        line = dict(zip(_Line._fields, table.T, strict=True))
        spacing = np.where(line["kind"] == KINDS.index("hair"), _HAIR_SPACING, _SPACING)
        counts = np.maximum(4, (line["length"] / spacing).astype(np.int64))
        before = lambda n: np.cumsum(n) - n  # noqa: E731
        knots = (_WALKS - 1) * line["place_knots"] + line["strength_knots"]
        firsts = np.stack([before(counts), before(line["corners"]), before(line["length"] + 1.0), before(knots)])
        loud = np.where(np.isin(line["kind"], [KINDS.index(k) for k in _LONG]), 0.25, 0.5)
        rows = np.concatenate([table, counts[:, None], firsts.T, loud[:, None]], 1)
        numbers = np.concatenate([rows.ravel(), *(c.ravel() for c in self._corners), *self._knots])
        return Lines(numbers, len(rows), int(line["corners"].sum()), int(counts.sum()))


def through(controls: np.ndarray, n: int = 40) -> np.ndarray:
    """A smooth polynomial curve of n points through 2 to 4 control points."""
    controls = np.asarray(controls, float)
    k, t = np.linspace(0, 1, len(controls)), np.linspace(0, 1, n)
    powers = np.polyfit(k, controls, min(3, len(controls) - 1))
    return np.stack([np.polyval(powers[:, j], t) for j in range(controls.shape[1])], 1)


def draw_fingers(atlas: Atlas, strokes: Strokes, identity: Identity) -> None:
    """Draw flexion creases on the palmar side, and folds over the joints on the back."""
    for finger, name in enumerate(FINGERS):
        for place in range(3):
            bone = atlas.body.bones[finger][place]
            _creases(atlas, strokes, identity, name, place, bone)
            if place > 0:
                _folds(atlas, strokes, identity, name, place, bone)


def arc(atlas: Atlas, name: str, bone: Bone, t: float, angles: np.ndarray, radius: float, bow: float) -> np.ndarray:
    """Surface points around a bone at `t` [mm]; angle 0 is the back, `bow` bends the arc along the bone."""
    around = np.cos(angles)[:, None] * bone.back + np.sin(angles)[:, None] * bone.side
    middle = angles - angles.mean()
    return atlas.snap(bone.origin + bone.along * (t + bow * middle**2)[:, None] + radius * around, name)


def _creases(atlas: Atlas, strokes: Strokes, identity: Identity, name: str, place: int, bone: Bone) -> None:
    rng, thumb = strokes.rng, name == "thumb"
    u = rng.uniform
    if place == 0 and not thumb:
        for t in (bone.length * 0.52, bone.length * 0.52 + 2.5)[: 1 + (rng.random() < 0.7)]:
            angles = np.pi + np.linspace(-1.6, 1.6, 30)
            strokes.add("crease", arc(atlas, name, bone, t + rng.normal(0, 0.7), angles, 10.0, rng.normal(0, 0.15)),
                        u(0.45, 0.65), u(0.5, 0.95), taper=0.3)  # fmt: skip
        return
    places = _THUMB_CREASES[place] if thumb else _CREASES[place]
    for t in places[: len(places) - (rng.random() < 0.15 and len(places) > 1)]:
        span = u(1.5, 2.0)
        angles = np.pi + rng.normal(0, 0.08) + np.linspace(-span, span, 30) * u(0.85, 1)
        line = arc(atlas, name, bone, t + rng.normal(0, 0.5), angles, 9.0, rng.normal(0, 0.15))
        strokes.add("crease", line, u(0.4, 0.62), u(0.7, 1.15) * (0.8 if place == 2 else 1), taper=0.3)
    for _ in range(rng.integers(2, 6) + int(5 * identity.line_wealth)):
        middle, half = np.pi + rng.normal(0, 0.7), u(0.25, 0.7)
        line = arc(atlas, name, bone, rng.normal(0, 3.2), np.linspace(middle - half, middle + half, 14), 9.0,
                    rng.normal(0, 0.3))  # fmt: skip
        strokes.add("crease", line, u(0.28, 0.42), u(0.15, 0.45), taper=0.5)
    for _ in range(int(rng.integers(2, 5) + 6 * identity.line_wealth)):  # lengthwise lines of the pads
        a, t0 = np.pi + rng.normal(0, 0.55), u(0.15, 0.75) * bone.length
        steps = np.linspace(0, u(3, 9), 10)
        around = np.cos(a) * bone.back + np.sin(a) * bone.side
        line = atlas.snap(bone.origin + bone.along * (t0 + steps)[:, None] + 9 * around, name)
        strokes.add("minor", line, u(0.26, 0.4), u(0.15, 0.4), taper=0.5)


def _folds(atlas: Atlas, strokes: Strokes, identity: Identity, name: str, place: int, bone: Bone) -> None:
    """Draw arcs that bend away from the joint, and broken wrinkles between them."""
    rng, thumb = strokes.rng, name == "thumb"
    u = rng.uniform
    count = ({1: 4, 2: 8} if thumb else {1: 9, 2: 5})[place] + rng.integers(-1, 2)
    reach = 5.0 if place == 1 or thumb else 2.6
    depth = identity.knuckles * (1 if place == 1 else 0.55)
    for t in np.linspace(-1, 1, count):
        half, middle = u(0.4, 0.8) * (1.2 - 0.1 * abs(t)), rng.normal(0, 0.14)
        angles = np.linspace(middle - half, middle + half, 16)
        line = arc(atlas, name, bone, t * reach + rng.normal(0, 0.4) - (place == 1), angles, 8.0,
                    -0.9 * np.sign(t) * abs(t) + rng.normal(0, 0.3))  # fmt: skip
        strokes.add("fold", line, u(0.45, 0.75), u(0.7, 1.6) * depth, taper=0.4, wobble=0.4)
    for _ in range(int(3 + 8 * identity.age)):
        middle, half = rng.normal(0, 0.4), u(0.15, 0.4)
        line = arc(
            atlas, name, bone, rng.normal(0, reach * 0.8), np.linspace(middle - half, middle + half, 10), 8.0, 0.0
        )
        strokes.add("fold", line, u(0.35, 0.5), u(0.3, 0.8) * depth, taper=0.5, wobble=0.5)


def draw_wrist(atlas: Atlas, strokes: Strokes) -> None:
    """Draw one to three lines across the inner side of the wrist."""
    rng = strokes.rng
    for x in (1.0, 5.5, 11.0)[: rng.integers(1, 4)]:
        z = np.linspace(-26, 26, 40)
        line = np.c_[x + rng.normal(0, 1) - rng.uniform(0.002, 0.006) * z**2, 0 * z, z]
        strokes.add("crease", atlas.snap(line, "wrist"), 0.7, rng.uniform(0.3, 0.9), taper=0.2, wobble=0.7)


def draw_back(atlas: Atlas, strokes: Strokes, identity: Identity) -> None:
    """Draw tendons to the knuckles, veins as random walks towards the wrist, fine cross lines and hairs."""
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
    """Draw bent hairs that lean towards the little finger, on the arm, the back and the first phalanges."""
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
        if np.abs(line[0] - root)[[0, 2]].max() < 4:  # else it fell beside the arm
            strokes.add("hair", line, 0.27, rng.uniform(0.35, 0.75), taper=0.4, wobble=0.08)


class Palm:
    """Draws the lines of one palm.

    Positions on the palm are (u, s): u is 0 below the index finger and 1 below the little finger, s is 0 at the wrist
    and 1 at the row of knuckles. Each line's course, length, breaks and branches are random.
    """

    def __init__(self, atlas: Atlas, strokes: Strokes, identity: Identity):
        self.atlas, self.strokes, self.identity, self.rng = atlas, strokes, identity, strokes.rng
        joints = atlas.body.hand.joints.double().numpy() * 1e3
        self.index, self.little = joints[_KNUCKLES[0]], joints[_KNUCKLES[2]]
        self.thumb = joints[13], joints[14]

    def place(self, us: np.ndarray) -> np.ndarray:
        """Surface points [mm] at rows of (u, s)."""
        u, s = np.asarray(us, float).T
        arch = np.array([-6.0, 0, 0]) * np.sin(np.pi * u.clip(0, 1))[:, None]
        top = self.index + (self.little - self.index) * u[:, None] + arch
        bottom = np.array([-6.0, 0, 0]) + np.array([0, 0, 1.0]) * (16 - 34 * u)[:, None]
        return self.atlas.snap(bottom + (top - bottom) * s[:, None], "palm")

    def line(self, kind: str, controls: np.ndarray, width: float, strength: float, *, branches: int = 0,
             gap: float = 0.0, wobble: float = 0.5) -> np.ndarray:  # fmt: skip
        """Draw a line with side branches; with probability `gap` it breaks and continues beside itself."""
        rng, curve = self.rng, through(controls, 48)
        if rng.random() < gap:
            cut, shift = rng.integers(14, 36), rng.normal(0, 0.035, 2)
            over = rng.integers(2, 7)
            self.strokes.add(kind, self.place(curve[: cut + over]), width, strength, taper=0.3, wobble=wobble)
            self.strokes.add(kind, self.place(curve[cut:] + shift), width * 0.9, strength * rng.uniform(0.6, 1),
                             taper=0.3, wobble=wobble)  # fmt: skip
        else:
            self.strokes.add(kind, self.place(curve), width, strength, taper=rng.uniform(0.12, 0.4), wobble=wobble)
        for _ in range(branches):
            i = rng.integers(4, 42)
            away = rng.normal(0, 0.10, 2) + (curve[i + 4] - curve[i]) * rng.uniform(0.5, 2.5)
            branch = curve[i] + np.linspace(0, 1, 12)[:, None] * away
            self.strokes.add(kind, self.place(branch), 0.55 * width, strength * rng.uniform(0.25, 0.6), taper=0.5,
                             wobble=wobble)  # fmt: skip
        return curve

    def draw(self) -> None:
        """Draw all lines of the palm."""
        life = self._main_lines()
        self._thenar(life)
        self._fine_lines()
        self._finger_roots()

    def _main_lines(self) -> np.ndarray:
        rng, depth, u = self.rng, self.identity.line_depth, self.rng.uniform
        jitter = lambda rows, sd=0.02: np.asarray(rows) + rng.normal(0, sd, np.shape(rows))  # noqa: E731
        n_branches = lambda: int(rng.integers(0, 2 + 3 * self.identity.line_wealth))  # noqa: E731
        start = np.array([u(-0.34, -0.22), u(0.84, 0.98)])
        belly, end = u(0.24, 0.52), u(-0.02, 0.34)
        life = self.line(
            "main", jitter([start, (belly * 0.55, u(0.70, 0.84)), (belly, u(0.40, 0.6)), (u(0.22, 0.48), end)]),
            u(0.8, 1.15), depth * u(0.8, 1.2), branches=n_branches(), gap=0.2,
        )  # fmt: skip
        self.strokes.add("halo", self.place(life), 2.6, depth)
        if rng.random() < SINGLE_CREASE:
            single = self.line("main", jitter([start, (0.2, 0.86), (0.65, 0.84), (1.15, u(0.72, 0.86))]), 0.95, depth,
                               branches=2)  # fmt: skip
            self.strokes.add("halo", self.place(single), 2.6, depth)
        else:
            joined = rng.random() < 0.65
            head_start = start + ([u(0, 0.05), u(0, 0.02)] if joined else [u(0, 0.08), u(0.05, 0.13)])
            drop, reach = u(0.05, 0.5), u(0.62, 1.05)
            head = self.line(
                "main", jitter([head_start, (0.12, 0.9 - 0.2 * drop), (0.5 * reach + 0.1, 0.86 - 0.5 * drop),
                                (reach, 0.82 - drop * u(0.8, 1.2))]),
                u(0.75, 1.1), depth * u(0.7, 1.15), branches=n_branches(), gap=0.25,
            )  # fmt: skip
            rise, finish = u(-0.02, 0.2), u(-0.02, 0.42)
            heart = self.line(
                "main", jitter([(u(1.15, 1.25), u(0.72, 0.84)), (0.9, 0.86 + 0.3 * rise), (0.6, 0.93 + 0.25 * rise),
                                (finish, 0.95 + rise)]),
                u(0.75, 1.1), depth * u(0.75, 1.2), branches=n_branches() + 1, gap=0.2,
            )  # fmt: skip
            for curve in (head, heart):
                self.strokes.add("halo", self.place(curve), 2.6, depth * 0.9)
        for chance, controls in (
            (0.6, [(u(0.3, 0.6), u(0.05, 0.35)), (0.48, 0.5), (u(0.35, 0.55), u(0.65, 0.95))]),  # fate
            (0.4, [(u(0.65, 0.85), u(0.3, 0.6)), (0.74, 0.7), (u(0.65, 0.8), 0.95)]),  # sun
            (0.3, [(u(0.35, 0.6), u(0.1, 0.3)), (0.8, 0.55), (1.0, u(0.75, 0.9))]),  # mercury
            (0.2, [(0.2, 1.02), (0.45, 0.96), (0.75, 1.0)]),  # girdle of Venus
        ):
            if rng.random() < chance:
                self.line("main", jitter(controls, 0.03), u(0.4, 0.6), depth * u(0.25, 0.6), branches=n_branches() // 2,
                          gap=0.4)  # fmt: skip
        for _ in range(rng.integers(1, 4)):  # short lines at the edge below the little finger
            s = u(0.86, 0.98)
            self.line("minor", jitter([(1.28, s), (1.1, s + u(-0.02, 0.03))], 0.01), 0.45, depth * u(0.4, 0.8))
        return life

    def _thenar(self, life: np.ndarray) -> None:
        """Draw the wrinkles of the thenar: along the life line and across it."""
        rng, u, age = self.rng, self.rng.uniform, self.identity.age
        root = np.array([-0.42, 0.22]) + rng.normal(0, 0.03, 2)  # middle of the thumb's side, in (u, s)
        for _ in range(int(rng.integers(9, 17) + 10 * age)):
            toward = u(0.08, 0.85)
            i = rng.integers(2, 26)
            part = life[i : i + rng.integers(9, 22)]
            bent = (
                part
                + (root - part) * toward
                + rng.normal(0, 0.012, (1, 2))
                + np.linspace(-1, 1, len(part))[:, None] * rng.normal(0, 0.03, 2)
            )
            self.strokes.add("wrinkle", self.place(bent), u(0.55, 0.9), u(0.4, 1.0), taper=0.4, wobble=0.5)
            if rng.random() < 0.35 + 0.4 * age:
                self.strokes.add("minor", self.place(bent), u(0.35, 0.5), u(0.2, 0.5), taper=0.5, wobble=0.4)
        for _ in range(int(rng.integers(5, 12) + 8 * age)):  # across: from the thumb's root over the ball
            i = rng.integers(8, 40)
            a, b = root + rng.normal(0, 0.08, 2), life[i]
            c = a + (b - a) * np.linspace(u(0.05, 0.3), u(0.6, 1.0), 14)[:, None]
            self.strokes.add("wrinkle", self.place(c), u(0.4, 0.7), u(0.25, 0.6), taper=0.5, wobble=0.6)
        web = np.array([-0.33, 0.86])
        for _ in range(rng.integers(4, 9)):  # the web between thumb and index
            c = (
                web
                + rng.normal(0, [0.05, 0.05], 2)
                + np.linspace(-1, 1, 12)[:, None] * np.array([u(0.05, 0.16), u(-0.1, 0.04)])
            )
            self.strokes.add("wrinkle", self.place(c), u(0.45, 0.7), u(0.4, 0.9), taper=0.5, wobble=0.4)
        for _ in range(rng.integers(4, 10)):  # the ball below the little finger
            c = np.array([u(0.75, 1.15), u(0.12, 0.6)]) + np.linspace(-1, 1, 12)[:, None] * [
                u(0.05, 0.16),
                u(-0.05, 0.06),
            ]
            self.strokes.add("wrinkle", self.place(c), u(0.4, 0.7), u(0.3, 0.7), taper=0.5, wobble=0.5)

    def _fine_lines(self) -> None:
        rng, identity = self.rng, self.identity
        favourite = rng.uniform(0, np.pi, 4)
        for _ in range(int(45 + 120 * identity.line_wealth + 40 * identity.age)):
            middle, angle = rng.uniform([-0.25, 0.05], [1.15, 1.06]), rng.choice(favourite) + rng.normal(0, 0.3)
            length = rng.uniform(0.06, 0.34)
            step = np.array([np.cos(angle), np.sin(angle)]) * length
            controls = middle + np.linspace(-0.5, 0.5, 4)[:, None] * step + rng.normal(0, 0.012, (4, 2))
            self.strokes.add("minor", self.place(through(controls, 16)), rng.uniform(0.3, 0.6),
                             rng.uniform(0.12, 0.6) * identity.line_depth, taper=0.5, wobble=0.5)  # fmt: skip

    def _finger_roots(self) -> None:
        """Draw short lines from the roots of the fingers into the palm."""
        rng = self.rng
        for middle in (0.0, 0.33, 0.67, 1.0):
            for _ in range(rng.integers(0, 4)):
                u = middle + rng.normal(0, 0.06)
                c = np.array([u, rng.uniform(1.02, 1.14)]) + np.linspace(0, 1, 10)[:, None] * [
                    rng.normal(0, 0.03),
                    -rng.uniform(0.05, 0.16),
                ]
                self.strokes.add("minor", self.place(c), 0.4, rng.uniform(0.2, 0.5), taper=0.5)
