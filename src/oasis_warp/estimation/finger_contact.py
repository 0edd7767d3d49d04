"""Where a bent hand probably touches itself: a term of the fit.

A photo of the palm's side shows that a finger is folded, and that the thumb lies before it, but not how deep they lie:
they move along the view. Without this term they float a centimetre apart, and from the side one looks through the hand.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.core.hand_model import finger_of
from oasis_warp.estimation.least_squares import cauchy
from oasis_warp.hand.kinematics import HandKinematics, PosedJoints

HALF_FOLDED, FOLDED = np.radians([185.0, 225.0])
"""Sum of a finger's three flexions from which its end is drawn to the palm, and from which wholly [rad]. Fingers that
meet the thumb in a ring bend by less."""
TOUCHES = 0.003
"""Gap between the nearest of the vertices of a finger and the palm that are compared, when they touch [m]: .5 to 3.5 mm
in the named fists, 5 mm in the median of folded fingers of the synthetic world."""
SIGMA, SCALE = 0.004, 2.5
"""Standard deviation of a gap [m], and the robust scale in sigmas (Cauchy)."""
REACH, INSIDE = 0.018, 0.006
"""Gap from which nothing is drawn, and how deep inside a finger the thumb may lie to be before it [m]. With 30 mm the
ring of thumb and index of one photo was closed. All of these were set by eye on 22 photos of
tests/data/photos/same_hand and five beside them, and compared on 120 synthetic photos of a world of their own."""
WEIGHT = 3.0
"""Number of observations that a contact counts as."""
ENDS, THUMB = (3, 6, 9, 12), 15
"""End joints of index, middle, little and ring finger, and of the thumb."""
FROM, TO = 0.35, 0.85
"""Part of the end bone whose skin touches; of fingers all from the first on."""
FACING, OPPOSED = 0.7, -0.3
"""Least cosine of the angle between normals of a palm or pad and their mean, largest of those of skin that touches."""
BEFORE = 0.004
"""Distance across the view up to which the thumb lies before a finger [m]."""
END_POINTS, PAD_POINTS, PALM_STEP, FINGER_STEP = 24, 6, 12, 6
"""Vertices of a finger's end and of the thumb's pad; every so-manieth vertex of palm and fingers is compared."""


class ContactTerm(NamedTuple):
    """C gaps of likely contacts."""

    residual: np.ndarray
    """Weighted, [C]."""
    jacobian: np.ndarray
    """By (angles, shape), [C, A + S]."""
    cost: float


class Gap(NamedTuple):
    """One of them."""

    size: float
    """[m]."""
    share: float
    """How folded the finger is, 0 to 1."""
    direction: np.ndarray
    """Unit vector along which it is measured, [3]."""
    one: np.ndarray
    """Vertices whose mean lies above, [n]."""
    other: int
    """The vertex below."""


class FingerContact:
    """The skin of a hand that touches when fingers fold."""

    def __init__(self, kinematics: HandKinematics):
        self.kinematics, hand = kinematics, kinematics.hand
        bone, place = hand.segment.cpu().numpy(), hand.bone_t.cpu().numpy()
        soft = (label_regions(hand).palm.cpu().numpy() > 0.5) & (hand.nail.cpu().numpy() == 0)

        def some(vertices: np.ndarray, count: int) -> np.ndarray:
            own = np.flatnonzero(vertices)
            return own[np.linspace(0, len(own) - 1, count).astype(int)]

        def facing(vertices: np.ndarray) -> np.ndarray:
            mean = kinematics.rest_normals[vertices].mean(0)
            return vertices & (kinematics.rest_normals @ mean > FACING * np.linalg.norm(mean))

        self.ends = [some((bone == joint) & soft & (place > FROM), END_POINTS) for joint in ENDS]
        self.pad = some(facing((bone == THUMB) & soft) & (place > FROM) & (place < TO), PAD_POINTS)
        self.palm = np.flatnonzero(facing((bone == 0) & soft))[::PALM_STEP]
        self.fingers = np.flatnonzero((bone > 0) & (bone <= max(ENDS)))[::FINGER_STEP]
        self.finger = finger_of(bone[self.fingers]) - 1
        self.joints = np.array(ENDS)[:, None] - [2, 1, 0]

    def term(self, joints: PosedJoints, camera: np.ndarray) -> ContactTerm:
        """Gaps between folded fingers and the palm, and between the thumb and the one it hides from `camera` [m]."""
        bend = (joints.angles[self.joints, 0] + self.kinematics.rest_bend[self.joints]).sum(1)
        share = np.clip((bend - HALF_FOLDED) / (FOLDED - HALF_FOLDED), 0, 1)
        gaps = [*self._folded(joints, share), *self._before(joints, share, camera)] if share.any() else []
        if not gaps:
            return ContactTerm(np.zeros(0), np.zeros((0, len(self.kinematics.dofs) + len(joints.shape))), 0.0)
        size, share = np.array([gap[:2] for gap in gaps]).T
        slope = self._slopes(joints, gaps)
        share = WEIGHT * np.where(np.abs(size) < REACH, share, 0)
        weight, loss = cauchy((np.append(size, REACH) / SIGMA) ** 2, SCALE)
        weight = np.sqrt(weight[:-1] * share) / SIGMA
        cost = share @ (loss[:-1] - loss[-1])  # 0 at the reach, so that it has no step there
        return ContactTerm(size * weight, slope * weight[:, None], float(cost))

    def _places(self, joints: PosedJoints, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and normals, nearly unit; without pose correctives."""
        normals = self.kinematics.blended(joints, index) @ self.kinematics.rest_normals[index][..., None]
        return self.kinematics.places(joints, index), normals[..., 0]

    def _slopes(self, joints: PosedJoints, gaps: list[Gap]) -> np.ndarray:
        """Derivatives of the gaps by (angles, shape), [C, A + S]."""
        index = np.concatenate([np.append(gap.one, gap.other) for gap in gaps])
        slopes = self.kinematics.vertices(joints, index, np.zeros((len(index), 3)))[1]
        parts = np.split(slopes, np.cumsum([len(gap.one) + 1 for gap in gaps])[:-1])
        return np.stack([
            gap.direction @ (part[:-1].mean(0) - part[-1]) for gap, part in zip(gaps, parts, strict=True)
        ])  # fmt: skip

    def _folded(self, joints: PosedJoints, share: np.ndarray) -> Iterator[Gap]:
        palm, normals = self._places(joints, self.palm)
        for end, own in zip(self.ends, share, strict=True):
            if own == 0:
                continue
            points, _ = self._places(joints, end)
            near = np.linalg.norm(palm - points[:, None], axis=2).argmin(1)
            sizes = (normals[near] * (points - palm[near])).sum(1)
            k = sizes.argmin()
            yield Gap(sizes[k] - TOUCHES, own, normals[near[k]], end[[k]], self.palm[near[k]])

    def _before(self, joints: PosedJoints, share: np.ndarray, camera: np.ndarray) -> Iterator[Gap]:
        points, inward = self._places(joints, self.pad)
        others, outward = self._places(joints, self.fingers)
        pad = points.mean(0)
        toward = (camera - pad) / np.linalg.norm(camera - pad)
        depth = (pad - others) @ toward
        aside = np.linalg.norm(pad - others - depth[:, None] * toward, axis=1)
        opposed = outward @ inward.mean(0) < OPPOSED
        behind = np.flatnonzero((aside < BEFORE) & opposed & (depth > -INSIDE) & (depth < REACH))
        if len(behind):
            k = behind[depth[behind].argmin()]
            yield Gap(depth[k], share[self.finger[k]], toward, self.pad, self.fingers[k])
