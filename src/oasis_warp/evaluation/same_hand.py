"""One photo's avatar against another photo of the same hand."""

from typing import NamedTuple

import torch
from torch import Tensor

from oasis_warp.avatar.appearance import label_regions, region_masks
from oasis_warp.avatar.observe import Observation, inner_mask, observe
from oasis_warp.core.config import BLACK
from oasis_warp.core.types import Evidence, HandPose
from oasis_warp.evaluation.coverage import COVERED
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.render.cameras import mirrored_camera


class PairScore(NamedTuple):
    """An avatar drawn as another photo of the same hand shows it, compared inside both masks."""

    psnr: float
    """After one gain a channel, since exposure and white balance differ between photos [dB]."""
    psnr_plain: float
    """Without it [dB]."""
    region_errors: dict[str, float]
    """Distance of the mean colours of each region that the other photo shows [sRGB], after the gain."""
    overlap: float
    """Intersection over union of the drawn hand and the other photo's mask."""


@torch.no_grad()
def compare_with_photo(avatar: Avatar, evidence: Evidence, pose: HandPose) -> PairScore:
    """Draw `avatar` in the `pose` and camera of another photo and compare.

    Args:
        avatar: Made from one photo; shape and looks come from it.
        evidence: Of the other photo (mirrored if it shows a left hand).
        pose: Of the other photo, in the photo's own frame.
    """
    camera = evidence.camera
    drawn = avatar.render(mirrored_camera(camera) if avatar.side == "left" else camera, pose, BLACK)
    image, alpha = drawn.image, drawn.alpha
    if avatar.side == "left":
        image, alpha = image.flip(1), alpha.flip(1)
    judged = evidence.above_wrist > 0.5
    mask = (evidence.mask > 0.5) & judged
    both = (inner_mask(evidence.mask) > 0.5) & (alpha >= COVERED) & judged
    weight = both.to(image)
    gain = (image * evidence.image * weight[..., None]).sum((0, 1)) / (
        (image**2 * weight[..., None]).sum((0, 1)).clamp_min(1e-6)
    )
    covered = (alpha > 0.5) & judged
    return PairScore(
        psnr=masked_psnr((image * gain).clamp(0, 1), evidence.image, weight),
        psnr_plain=masked_psnr(image, evidence.image, weight),
        region_errors=_region_errors(avatar, evidence, pose, gain),
        overlap=float((covered & mask).sum() / (covered | mask).sum().clamp_min(1)),
    )


def _region_errors(avatar: Avatar, evidence: Evidence, pose: HandPose, gain: Tensor) -> dict[str, float]:
    hand, index = avatar.hand, avatar.gaussians.vertex_index
    seen: Observation = observe(hand, evidence)
    colors, present = torch.zeros_like(seen.colors), torch.zeros_like(seen.confidence)
    colors[index], present[index] = avatar.gaussians.colors[: len(index)], 1
    errors = {}
    for name, where in region_masks(label_regions(hand)).items():
        weight = (where * seen.confidence * present)[:, None]
        if float(weight.sum()) < 20:  # vertices: too few to speak of a region
            continue
        difference = ((colors * gain - seen.colors) * weight).sum(0) / weight.sum()
        errors[name] = float(difference.norm())
    return errors
