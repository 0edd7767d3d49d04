"""How good a fit is: its numbers, the warnings about it, and when it is refused.

Numbers compare the model with landmarks and mask. Further warnings come from a second detection in rotated crops, which
checks the fingers and the side of the hand, and from the hand's place in the photo.
"""

from dataclasses import dataclass, replace

import numpy as np

from oasis_warp.core.hand_model import HandModel, finger_of
from oasis_warp.core.mirror import MIRROR
from oasis_warp.core.types import HandFit, HandPose
from oasis_warp.estimation.fit import FitSettings, Fitter, SurfacePoints
from oasis_warp.estimation.fit_problem import FitState, FitTarget, fit_target, mirrored_fit
from oasis_warp.estimation.landmarks import FINGERS, DetectedHand, crop_of_landmarks, read_crop
from oasis_warp.estimation.networks import Networks
from oasis_warp.estimation.outline import silhouette, wrist_line
from oasis_warp.hand.kinematics import HandKinematics

SMALL_HAND, LOW_DETAIL, TINY_HAND = 150, 80, 40
"""Longer side of the landmarks' box [px] below which a hand gets a warning, a stronger one, and is refused. 22 photos,
shrunk to hands of 40 px, give surfaces that lie 1.3 % of the box from the whole photos' in the median, 2 % at the 80th
percentile; at 80 px it is .5 and .8 %. One of the 22 is refused for its fit at 40 px."""
MANY_FINGERS = 4
"""A hand with this many doubtful fingers is somewhere else."""
_ANY_POSE = FitSettings(gesture=(1.0, 1.0, 1.0))
"""Of the fits that tell the sides apart: a flat hand of the other side makes a gesture, too."""
_SIDE_RATIO = 1.1
"""Ratio of the other side's cost to this one's below which the side is doubtful; at least 1.14 on 66 correct fits."""
_FINGER_GAP = 0.06
"""Distance of a finger in the second detection, as a fraction of the box; at most .04 where it is correct."""
_CROP_ROTATION = 0.3
"""Angle by which the crop of the second detection is rotated [rad]."""
_MIN_PRESENCE = 0.5
_STRAY = 0.06
"""Distance of a pixel from its place on the model, as a fraction of the box, beyond which it strays."""
STRAY_SHARE = 0.35
"""Share of all pixels that stray from which a fit is refused. At most .19 where the fit looks right."""
AGREED_IOU, AGREED_STRAY = 0.96, 0.1
"""Outline and share of straying pixels from which the photo speaks for a fit, and its landmarks are taken to be wrong.
Of 160 synthetic photos that no table uses, 8 fits break the bound of landmarks alone: the five that agree so are off by
1.8 to 5.4 px, and by 3.3 to 5.9 mm after alignment, the other three by 3 to 8.3 px and 10 to 32 mm."""
_STRAY_WARNED, _STRAY_FINGER = 0.2, 0.65
"""Shares of all pixels, and of those of a finger, about which a warning is given."""
_MIN_PIXELS = 12
"""Least pixels of a finger that is judged."""
_FINGERS_OF_JOINTS = ("index", "middle", "little", "ring", "thumb")
"""In the order of the model's joints."""
_BORDER = 0.08
"""Length along which a hand may touch the photo's border, as a fraction of the box."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of the numbers of a fit. Fits that look right keep them, most damaged ones do not."""

    reprojection: float
    worst_point: float
    mask_iou: float
    cost: float


WARN_BOUNDS = Bounds(reprojection=4.5, worst_point=11.0, mask_iou=0.91, cost=280.0)
REFUSE_BOUNDS = Bounds(reprojection=6.5, worst_point=np.inf, mask_iou=0.85, cost=560.0)


@dataclass(frozen=True)
class FitQuality:
    """The numbers of a fit, named as in `HandFit`."""

    reprojection: float
    """Mean distance of the landmarks from the model's [% of the box]."""
    worst_point: float
    """Largest of these distances [%]."""
    mask_iou: float
    """Intersection over union of mesh and mask, above the wrist line."""
    cost: float

    def beyond(self, bounds: Bounds) -> list[str]:
        """The numbers that break `bounds`, in words."""
        broken = []
        if self.reprojection > bounds.reprojection:
            broken.append(f"the reprojection error is {self.reprojection:.1f} % of the hand's size")
        if self.worst_point > bounds.worst_point:
            broken.append(f"one landmark is {self.worst_point:.1f} % of the hand's size away from the model")
        if self.mask_iou < bounds.mask_iou:
            broken.append(f"the model does not match the hand's outline (IoU {self.mask_iou:.2f})")
        if self.cost > bounds.cost:
            broken.append(f"no plausible hand matches the landmarks and the outline (cost {self.cost:.0f})")
        return broken

    def refused(self, stray: float) -> list[str]:
        """Why the fit is too poor to use, in words, given the share of pixels that stray; empty for a usable one."""
        agrees = self.mask_iou >= AGREED_IOU and stray <= AGREED_STRAY
        broken = self.beyond(replace(REFUSE_BOUNDS, reprojection=np.inf) if agrees else REFUSE_BOUNDS)
        if stray > STRAY_SHARE:
            broken.append(f"{100 * stray:.0f} % of the hand's pixels do not match the model")
        return broken

    def warnings(self) -> list[str]:
        """What to tell the user about these numbers; empty for a good fit."""
        return [f"poor fit: {words}" for words in self.beyond(WARN_BOUNDS)]


def fit_quality(
    kinematics: HandKinematics, target: FitTarget, state: FitState, mask: np.ndarray, cost: float
) -> FitQuality:
    """Compare the model in `state` with the landmarks and the mask ([H, W], mirrored as the target is)."""
    points = state.project(kinematics.landmarks(kinematics.pose_joints(state.angles, state.shape))[0])
    errors = np.linalg.norm(points - target.xy, axis=1) / target.box * 100
    drawn = draw_silhouette(kinematics, state, target.size)
    return FitQuality(
        float(errors.mean()), float(errors.max()), iou_above_wrist(drawn > 0, mask > 0.5, target.xy), cost
    )


def draw_silhouette(kinematics: HandKinematics, state: FitState, size: tuple[int, int]) -> np.ndarray:
    """Silhouette of the model in a photo of `size` (width, height), 0 or 255."""
    surface = kinematics.surface(kinematics.pose_joints(state.angles, state.shape))
    return silhouette(state.project(surface), kinematics.faces, size)


def iou_above_wrist(drawn: np.ndarray, mask: np.ndarray, xy: np.ndarray) -> float:
    """Intersection over union of two masks above the wrist line of the landmarks."""
    hand = wrist_line(xy).above_mask((mask.shape[1], mask.shape[0]))
    union = int(((drawn | mask) & hand).sum())
    return int((drawn & mask & hand).sum()) / max(union, 1)


def with_pose(hand: HandModel, fit: HandFit, pose: HandPose) -> HandFit:
    """`fit` in another pose, with its numbers computed again; cost and warnings stay those of the fit.

    Args:
        hand: The model.
        fit: In the photo's own frame.
        pose: In the same frame: a left hand's pose describes the mirrored model.
    """
    kinematics, moved = HandKinematics(hand), fit._replace(pose=pose)
    view = mirrored_fit(kinematics, moved)
    target = fit_target(view.xy, None, (fit.camera.width, fit.camera.height))
    return moved._replace(**vars(fit_quality(kinematics, target, view.state, view.mask, fit.cost)))


def keeps_quality(moved: HandFit, fit: HandFit) -> bool:
    """Whether each number of `moved` is within the bounds of warnings, or no worse than that of `fit`."""
    return (
        moved.reprojection <= max(WARN_BOUNDS.reprojection, fit.reprojection)
        and moved.worst_point <= max(WARN_BOUNDS.worst_point, fit.worst_point)
        and moved.mask_iou >= min(WARN_BOUNDS.mask_iou, fit.mask_iou)
    )


def second_detections(rgb: np.ndarray, nets: Networks, xy: np.ndarray) -> list[DetectedHand]:
    """Detections in a rotated crop and in a mirrored one rotated the other way, without those that find no hand.

    Reliable landmarks move little.
    """
    crop = crop_of_landmarks(xy)
    rotated = read_crop(rgb, nets, replace(crop, angle=crop.angle + _CROP_ROTATION))
    mirrored = read_crop(rgb, nets, replace(crop, angle=crop.angle - _CROP_ROTATION), mirrored=True)
    return [detection for detection in (rotated, mirrored) if detection.presence >= _MIN_PRESENCE]


def finger_warnings(target: FitTarget, detections: list[DetectedHand]) -> list[str]:
    """Fingers that every second detection finds somewhere else."""
    warnings = []
    for finger, rows in FINGERS.items():
        gaps = [np.linalg.norm(found.xy[rows] - target.xy[rows], axis=1).mean() / target.box for found in detections]
        if gaps and min(gaps) > _FINGER_GAP:
            warnings.append(
                f"{finger} {'' if finger == 'thumb' else 'finger '}doubtful: a second detection places it "
                f"{100 * min(gaps):.0f} % of the hand's size away"
            )
    return warnings


def stray_pixels(
    kinematics: HandKinematics, target: FitTarget, state: FitState, points: SurfacePoints
) -> tuple[float, list[str]]:
    """Share of the pixels whose places on the fitted surface lie elsewhere, and warnings about fingers."""
    if not len(points.vertex):
        return 0.0, []
    surface = kinematics.surface(kinematics.pose_joints(state.angles, state.shape))
    gap = np.linalg.norm(state.project(surface[points.vertex]) - points.xy, axis=1)
    stray = gap > _STRAY * target.box
    finger = finger_of(kinematics.weights[points.vertex].argmax(1))
    warnings = []
    for number, name in enumerate(_FINGERS_OF_JOINTS, 1):
        own = stray[finger == number]
        if len(own) >= _MIN_PIXELS and own.mean() > _STRAY_FINGER:
            warnings.append(
                f"{name} {'' if name == 'thumb' else 'finger '}doubtful: {100 * own.mean():.0f} % of its pixels "
                "do not match the fitted hand"
            )
    if stray.mean() > _STRAY_WARNED:
        warnings.insert(0, f"poor fit: {100 * stray.mean():.0f} % of the hand's pixels do not match the model")
    return float(stray.mean()), warnings


def side_costs(kinematics: HandKinematics, target: FitTarget, shape: np.ndarray | None) -> tuple[float, float]:
    """Costs of fitting the landmarks as a hand of this side and of the other one, in any pose that joints allow."""
    mirrored = replace(
        target,
        xy=np.array([target.size[0], 0]) + target.xy * [-1, 1],
        directions=None if target.directions is None else target.directions * MIRROR,
    )
    own, other = (
        Fitter(kinematics, side, settings=_ANY_POSE, shape=shape).fit_landmarks().cost for side in (target, mirrored)
    )
    return own, other


def side_warnings(side: str, cost: float, other_cost: float, detections: list[DetectedHand]) -> list[str]:
    """Whether the landmarks bend like a hand of the other side, or every second detection finds one.

    The detections are those of a right hand's view: one that is called left is of the other side.
    """
    ratio, warnings = other_cost / max(cost, 1e-9), []
    other = "left" if side == "right" else "right"
    if ratio < _SIDE_RATIO:
        warnings.append(f"side doubtful: as a {other} hand, the fit costs only {ratio:.2f} times as much")
    if detections and max(found.right for found in detections) < 0.5:
        warnings.append(f"side doubtful: a second detection sees a {other} hand")
    return warnings


def framing_warnings(target: FitTarget, mask: np.ndarray) -> list[str]:
    """Whether the hand is small, or cut by the photo's border."""
    warnings = []
    if target.box < SMALL_HAND:
        low = target.box < LOW_DETAIL
        what = "the avatar has little detail and its pose may be wrong" if low else "the avatar will be blurred"
        warnings.append(f"small hand: {target.box:.0f} pixels, less than {SMALL_HAND}; {what}")
    width, height = target.size
    hand = (mask > 0.5) & wrist_line(target.xy).above_mask(target.size)
    touching = sum(int(line.sum()) for line in (hand[0], hand[-1], hand[:, 0], hand[:, -1]))
    outside = bool(((target.xy < 0) | (target.xy > [width, height])).any())
    if outside or touching > _BORDER * target.box:
        warnings.append("the photo's border cuts the hand: the part outside is guessed")
    return warnings
