"""How good a fit is: its numbers, what to warn about, and when to refuse it."""

from dataclasses import dataclass

import numpy as np

from oasis_warp.estimation.fit_state import FitState
from oasis_warp.estimation.fit_target import Evidence
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.silhouette import silhouette
from oasis_warp.hand.kinematics import HandKinematics

SMALL_HAND, TINY_HAND = 150, 80
"""Longer side of the landmarks' box [px] below which a hand is warned about, and refused."""


@dataclass(frozen=True)
class Bounds:
    """Numbers that a fit should keep: above 63 correct fits, below most damaged ones."""

    reprojection: float
    worst_point: float
    mask_iou: float
    cost: float


WARN_BOUNDS = Bounds(reprojection=2.3, worst_point=8.0, mask_iou=0.90, cost=170.0)
REFUSE_BOUNDS = Bounds(reprojection=4.0, worst_point=np.inf, mask_iou=0.85, cost=400.0)


@dataclass(frozen=True)
class Quality:
    """What a fit leaves unexplained."""

    point_errors: np.ndarray
    """Distance of each landmark to the model's [% of the box]."""
    mask_iou: float
    """Of mesh and mask, above the wrist line."""
    cost: float

    @property
    def reprojection(self) -> float:
        """Mean of the point errors [%]."""
        return float(self.point_errors.mean())

    @property
    def worst_point(self) -> float:
        """Largest of the point errors [%]."""
        return float(self.point_errors.max())

    def beyond(self, bounds: Bounds) -> list[str]:
        """The numbers that break `bounds`, in words."""
        said = []
        if self.reprojection > bounds.reprojection:
            said.append(f"the landmarks lie {self.reprojection:.1f} % of the hand's size from the model's")
        if self.worst_point > bounds.worst_point:
            said.append(f"one landmark lies {self.worst_point:.1f} % of the hand's size from the model's")
        if self.mask_iou < bounds.mask_iou:
            said.append(f"the model covers the hand's outline badly (IoU {self.mask_iou:.2f})")
        if self.cost > bounds.cost:
            said.append(f"the landmarks and the outline contradict a plausible hand (cost {self.cost:.0f})")
        return said


def measure(rig: HandKinematics, evidence: Evidence, state: FitState, mask: np.ndarray, cost: float) -> Quality:
    """Compare the model in `state` with the landmarks and the mask ([H, W], mirrored like the evidence)."""
    points = state.project(rig.landmarks(rig.chain(state.angles, state.shape), state.shape)[0])
    errors = np.linalg.norm(points - evidence.xy, axis=1) / evidence.box * 100
    return Quality(errors, overlap(draw(rig, state, evidence.size) > 0, mask > 0.5, evidence.xy), cost)


def draw(rig: HandKinematics, state: FitState, size: tuple[int, int]) -> np.ndarray:
    """Silhouette of the model in a photo of `size` (width, height), 0 or 255."""
    surface = rig.surface(rig.chain(state.angles, state.shape), state.angles, state.shape)
    return silhouette(state.project(surface), rig.faces, size)


def overlap(drawn: np.ndarray, mask: np.ndarray, xy: np.ndarray) -> float:
    """Intersection over union of two masks above the wrist line of the landmarks."""
    hand = wrist_line(xy).above_mask((mask.shape[1], mask.shape[0]))
    union = int(((drawn | mask) & hand).sum())
    return int((drawn & mask & hand).sum()) / max(union, 1)
