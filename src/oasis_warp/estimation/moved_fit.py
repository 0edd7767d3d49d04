"""A fit whose hand was moved afterwards, and what it is worth then."""

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandFit, HandPose
from oasis_warp.estimation.fit_quality import WARN_BOUNDS, measure
from oasis_warp.estimation.fit_target import evidence_of
from oasis_warp.estimation.mirrored_input import mirrored_fit
from oasis_warp.hand.kinematics import HandKinematics


def with_pose(hand: HandModel, fit: HandFit, pose: HandPose) -> HandFit:
    """`fit` in another pose, measured anew; cost and warnings stay those of the fit.

    Args:
        hand: The model.
        fit: In the photo's own frame.
        pose: In that frame, too: a left hand's describes the mirrored model.
    """
    rig, moved = HandKinematics(hand), fit._replace(pose=pose)
    view = mirrored_fit(rig, moved)
    evidence = evidence_of(view.xy, None, (fit.camera.width, fit.camera.height))
    quality = measure(rig, evidence, view.state, view.mask, fit.cost)
    return moved._replace(
        reprojection=quality.reprojection, worst_point=quality.worst_point, mask_iou=quality.mask_iou
    )


def keeps_quality(moved: HandFit, fit: HandFit) -> bool:
    """Whether no number of `moved` is beyond what is warned about, unless that of `fit` is, too."""
    return (
        moved.reprojection <= max(WARN_BOUNDS.reprojection, fit.reprojection)
        and moved.worst_point <= max(WARN_BOUNDS.worst_point, fit.worst_point)
        and moved.mask_iou >= min(WARN_BOUNDS.mask_iou, fit.mask_iou)
    )
