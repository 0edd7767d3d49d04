"""What makes the input of a fit doubtful, found by looking again: the side, single fingers, the photo's border."""

from dataclasses import replace

import numpy as np

from oasis_warp.estimation.fit import Fitter, Solution
from oasis_warp.estimation.fit_quality import SMALL_HAND
from oasis_warp.estimation.fit_target import Evidence
from oasis_warp.estimation.landmarks import FINGERS, DetectedHand, crop_of_landmarks, read_crop
from oasis_warp.estimation.networks import Networks
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.hand.kinematics import HandKinematics

SIDE_RATIO = 1.15
"""The other side's cost over this one's: at least 1.3 on 63 right fits, so less is a doubt."""
_FINGER_GAP = 0.06
"""Share of the box by which a finger may move when the network looks again; right ones move by 0.04 at most."""
MANY_FINGERS = 4
"""So many doubtful fingers are a hand somewhere else."""
_TURN = 0.3
"""Angle by which the second look is turned [rad]."""
_MIN_PRESENCE = 0.5
_BORDER = 0.08
"""Share of the box along which a hand may touch the photo's border."""


def second_detections(rgb: np.ndarray, nets: Networks, xy: np.ndarray) -> list[DetectedHand]:
    """What the landmark network sees in the same place in a turned crop, and in a mirrored one turned the other way.

    Landmarks that mean something move little; a look in which it sees no hand is left out.
    """
    crop = crop_of_landmarks(xy)
    turned = read_crop(rgb, nets, replace(crop, angle=crop.angle + _TURN))
    mirrored = read_crop(rgb, nets, replace(crop, angle=crop.angle - _TURN), mirrored=True)
    return [look for look in (turned, mirrored) if look.presence >= _MIN_PRESENCE]


def finger_warnings(evidence: Evidence, looks: list[DetectedHand]) -> list[str]:
    """Fingers that every second look sees somewhere else."""
    if not looks:
        return []
    said = []
    for finger, rows in FINGERS.items():
        gaps = [np.linalg.norm(look.xy[rows] - evidence.xy[rows], axis=1).mean() / evidence.box for look in looks]
        if min(gaps) > _FINGER_GAP:
            said.append(
                f"{finger} {'' if finger == 'thumb' else 'finger '}doubtful: on a second look it lies "
                f"{100 * min(gaps):.0f} % of the hand's size elsewhere"
            )
    return said


def other_side_cost(rig: HandKinematics, evidence: Evidence, shape: np.ndarray | None) -> float:
    """Cost of fitting the landmarks as a hand of the other side."""
    width = evidence.size[0]
    mirrored = replace(
        evidence,
        xy=np.array([width, 0]) + evidence.xy * [-1, 1],
        directions=None if evidence.directions is None else evidence.directions * [-1, 1, 1],
    )
    return Fitter(rig, mirrored, shape=shape).fit_landmarks().cost


def side_warnings(side: str, start: Solution, other_cost: float, looks: list[DetectedHand]) -> list[str]:
    """Whether the landmarks bend like a hand of the other side, or the network sees one on a second look.

    `looks` are in the right-handed view: a hand that they call left is of the other side.
    """
    ratio, said = other_cost / max(start.cost, 1e-9), []
    if ratio < SIDE_RATIO:
        said.append(f"side doubtful: the landmarks of a {_other(side)} hand would cost {ratio:.2f} times as much")
    if looks and max(look.right for look in looks) < 0.5:
        said.append(f"side doubtful: on a second look the network sees a {_other(side)} hand")
    return said


def _other(side: str) -> str:
    return "left" if side == "right" else "right"


def framing_warnings(evidence: Evidence, mask: np.ndarray) -> list[str]:
    """Whether the hand is small, or cut by the photo's border."""
    said = []
    if evidence.box < SMALL_HAND:
        said.append(f"small hand: {evidence.box:.0f} pixels, the avatar will be blurred below {SMALL_HAND}")
    width, height = evidence.size
    hand = (mask > 0.5) & wrist_line(evidence.xy).above_mask(evidence.size)
    touching = sum(int(line.sum()) for line in (hand[0], hand[-1], hand[:, 0], hand[:, -1]))
    outside = bool(((evidence.xy < 0) | (evidence.xy > [width, height])).any())
    if outside or touching > _BORDER * evidence.box:
        said.append("the hand is cut by the photo's border: what lies outside is guessed")
    return said
