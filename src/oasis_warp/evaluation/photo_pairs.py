"""One photo's avatar against other photos of the same hand: what no truth but a second photo can say."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from oasis_warp.avatar.appearance import label_regions, region_masks
from oasis_warp.avatar.observation import Observation, inner_mask, observe
from oasis_warp.core.config import BLACK, ReconstructConfig
from oasis_warp.core.mirror import mirror_camera
from oasis_warp.core.types import HandCrop, HandPose, Landmarks, Photo, Render
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.evaluation.coverage import COVERED
from oasis_warp.evaluation.metrics import color_gain
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr, ssim_map
from oasis_warp.reconstruction import crop_hand

QUARTER = 4
"""Side of the blocks on which structure is compared [px]: a pose that is a little off moves all detail."""
FEWEST_VERTICES = 20
"""Of a region, else its colour is not compared."""


class PairScore(NamedTuple):
    """An avatar drawn as another photo of the same hand shows it, compared inside both masks."""

    psnr: float
    """After one gain a channel, since exposure and white balance differ between photos [dB]."""
    psnr_plain: float
    """Without it [dB]."""
    ssim_quarter: float
    """At a quarter of the size, after the gain."""
    region_errors: dict[str, float]
    """Distance of the mean colours of each region that the other photo shows [sRGB], after the gain."""
    overlap: float
    """Intersection over union of the drawn hand and the other photo's mask."""


class Pair(NamedTuple):
    """Avatars of the photo `source` beside the photo `target`; pictures of left hands are mirrored."""

    source: str
    target: str
    photo: Float[Tensor, "S S 3"]
    drawn: dict[str, Float[Tensor, "S S 3"]]
    scores: dict[str, PairScore]
    """By name of the avatar, as `drawn`."""


def compare_pairs(
    estimator: HandEstimator,
    photos: Mapping[str, tuple[Photo, Landmarks]],
    avatars: Mapping[str, Mapping[str, Avatar]],
    config: ReconstructConfig,
) -> Iterator[Pair]:
    """Every ordered pair of different photos that show the same side; pose and camera of the second are estimated.

    Args:
        estimator: Fits the second photo, with the shape of the first one's avatars.
        photos: Of one hand, and where it is in each.
        avatars: By photo and then by a name, all of one photo with the same surface; photos without are targets only.
        config: Size of the pictures and device.
    """
    for target, (photo, landmarks) in photos.items():
        for source, made in avatars.items():
            if source == target or not made:
                continue
            first = next(iter(made.values()))
            fit = estimator.fit(photo, landmarks, shape=first.shape.cpu(), force=True)
            if fit.side != first.side:
                continue
            crop = crop_hand(photo, fit, first.surface_offsets.cpu(), config)
            drawn = {name: draw_as_photo(avatar, crop, fit.pose) for name, avatar in made.items()}
            scores = {
                name: compare_with_photo(avatar, drawn[name], crop, fit.pose) for name, avatar in made.items()
            }
            yield Pair(source, target, crop.image, {name: what.image for name, what in drawn.items()}, scores)


@torch.no_grad()
def draw_as_photo(avatar: Avatar, crop: HandCrop, pose: HandPose) -> Render:
    """`avatar` in the `pose`, in its photo's own frame, and camera of another photo; a left hand is mirrored."""
    left = avatar.side == "left"
    drawn = avatar.render(mirror_camera(crop.camera) if left else crop.camera, pose, BLACK)
    return Render(drawn.image.flip(1), drawn.alpha.flip(1)) if left else drawn


@torch.no_grad()
def compare_with_photo(avatar: Avatar, drawn: Render, crop: HandCrop, pose: HandPose) -> PairScore:
    """Compare what `draw_as_photo` drew of `avatar` in `pose` with the photo of `crop`."""
    image, alpha = drawn
    judged = crop.above_wrist > 0.5
    mask = (crop.mask > 0.5) & judged
    weight = ((inner_mask(crop.mask) > 0.5) & (alpha >= COVERED) & judged).to(image)
    gain = color_gain(image, crop.image, weight)
    matched = (image * gain).clamp(0, 1)
    covered = (alpha > 0.5) & judged
    return PairScore(
        psnr=masked_psnr(matched, crop.image, weight),
        psnr_plain=masked_psnr(image, crop.image, weight),
        ssim_quarter=_small_ssim(matched, crop.image, weight),
        region_errors=_region_errors(avatar, avatar.pose(pose).colors, crop, gain),
        overlap=float((covered & mask).sum() / (covered | mask).sum().clamp_min(1)),
    )


def _small_ssim(image: Tensor, target: Tensor, weight: Tensor) -> float:
    """Of the mean colours of blocks, over black beyond `weight`."""
    planes = torch.cat([image * weight[..., None], target * weight[..., None], weight[..., None]], -1)
    small = avg_pool2d(planes.permute(2, 0, 1), QUARTER).permute(1, 2, 0)
    share = small[..., 6]
    similarity = ssim_map(small[..., :3], small[..., 3:6])
    return float((similarity * share).sum() / share.sum().clamp_min(1e-6))


def _region_errors(
    avatar: Avatar, lit: Float[Tensor, "N 3"], crop: HandCrop, gain: Tensor
) -> dict[str, float]:
    hand, index = avatar.hand, avatar.gaussians.vertex_index
    seen: Observation = observe(hand, crop)
    colors, present = torch.zeros_like(seen.colors), torch.zeros_like(seen.confidence)
    colors[index], present[index] = lit[: len(index)], 1
    errors = {}
    for name, where in region_masks(label_regions(hand)).items():
        weight = (where * seen.confidence * present)[:, None]
        if float(weight.sum()) < FEWEST_VERTICES:
            continue
        difference = ((colors * gain - seen.colors) * weight).sum(0) / weight.sum()
        errors[name] = float(difference.norm())
    return errors
