"""Training batches from pictures of posed hands: mirrored to right hands, cropped, with the estimator's errors."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_images
from oasis_warp.core.types import TrainingBatch
from oasis_warp.pretraining.estimator_errors import (
    ALIKE,
    MASK_NUMBERS,
    EstimatedHands,
    bundled_errors,
    cut_at_wrist,
    perturb_outline,
    simulate_estimate,
)
from oasis_warp.pretraining.hand_batch import PosedHands, pose_hands

CROP_MARGIN = 1.12
"""Side of a crop over the longer extent of its mask, as in `reconstruction.reconstruct`."""


@runtime_checkable
class LabelledPictures(Protocol):
    """N pictures with ground truth, from any renderer of hands.

    Poses are in the camera's frame; that of a left hand describes the mirrored model (x -> -x).
    """

    image: Float[Tensor, "N H H 3"]
    """Colours (sRGB)."""
    alpha: Float[Tensor, "N H H"]
    """Share of each pixel that is not background."""
    mask: Float[Tensor, "N H H"]
    """Share of each pixel that is hand."""
    angles: Float[Tensor, "N 15 3"]
    """As `HandPose.angles`."""
    orientation: Float[Tensor, "N 3 3"]
    """From the hand's frame to the camera's."""
    translation: Float[Tensor, "N 3"]
    """Position of the hand's origin [m]."""
    shape: Float[Tensor, "N S"]
    """Shape coefficients."""
    K: Float[Tensor, "N 3 3"]
    """Intrinsics [px]."""
    left: Int[Tensor, "N"]
    """1 for left hands."""


@dataclass(frozen=True, kw_only=True)
class EstimatorNoise:
    """Strength of the estimator's errors in the network's input: 1 as measured, 0 for none."""

    surface: float = 1.0
    """Strength of errors in pose, shape and camera."""
    mask: float = 1.0
    """Strength of errors in the mask, and so in the crop around it."""


class Crops(NamedTuple):
    """Square crops, channels last."""

    planes: Float[Tensor, "N s s C"]
    K: Float[Tensor, "N 3 3"]


def crop_to_mask(
    planes: Float[Tensor, "N H H C"],
    mask: Float[Tensor, "N H H"],
    K: Float[Tensor, "N 3 3"],
    size: int,
) -> Crops:
    """Crop the squares around the masks to `size` pixels, bilinearly and without waiting for the device.

    An empty mask keeps the whole picture.
    """
    full = planes.shape[1]
    inside = mask > 0.5
    low, high = zip(*(_extent(inside.any(axis)) for axis in (1, 2)), strict=True)  # columns, then rows
    low, high = torch.stack(low, 1), torch.stack(high, 1)
    side = CROP_MARGIN * (high - low).amax(1, keepdim=True)
    corner = (low + high - side) / 2
    cells = (torch.arange(size, dtype=K.dtype, device=K.device) + 0.5) / size
    x, y = (corner[:, k, None] + cells * side for k in range(2))
    grid = torch.stack(torch.broadcast_tensors(x[:, None], y[:, :, None]), dim=-1) * 2 / full - 1
    cut = grid_sample(planes.permute(0, 3, 1, 2), grid, align_corners=False).permute(0, 2, 3, 1)
    scale = size / side[:, 0]
    moved = K.clone()
    moved[:, :2, 2] -= corner
    moved[:, :2] *= scale[:, None, None]
    return Crops(cut, moved)


def _extent(touched: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the first true value of each row, and one past the last, as floats; the whole row if none is true."""
    n = touched.shape[1]
    first = touched.int().argmax(1)
    last = n - touched.flip(1).int().argmax(1)
    return first.float(), last.float()


def mirror_left_hands(pictures: LabelledPictures) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Image, alpha, mask, orientation, translation and K, with left hands mirrored to right ones."""
    left, like = pictures.left.bool(), pictures.translation
    sign = torch.ones_like(like)
    sign[:, 0] -= 2 * left
    K = pictures.K.clone()
    K[:, 0, 2] = torch.where(left, pictures.image.shape[2] - K[:, 0, 2], K[:, 0, 2])
    orientation = sign[:, :, None] * pictures.orientation * sign[:, None]
    image, alpha, mask = (mirror_images(planes, left) for planes in (pictures.image, pictures.alpha, pictures.mask))
    return image, alpha, mask, orientation, sign * like, K


@torch.no_grad()
def training_batch(
    hand: HandModel,
    photos: LabelledPictures,
    targets: LabelledPictures,
    size: int,
    random: torch.Generator,
    noise: EstimatorNoise = EstimatorNoise(),
) -> TrainingBatch:
    """B photos and T target pictures of each hand as a training batch.

    Args:
        hand: Hand model on the device of the pictures.
        photos: B photos.
        targets: B T pictures of the hands over black, those of the first hand first.
        size: Side of the crops [px].
        random: Generator on the CPU of the estimator's errors; the same state gives the same batch.
        noise: Strength of these errors, which affect only the photo's `posed`, `K`, `mask` and crop.
    """
    image, alpha, mask, orientation, translation, K = mirror_left_hands(photos)
    count, like = len(image), translation

    views = len(targets.image) // count
    goal_image, goal_alpha, goal_mask, *place, goal_K = mirror_left_hands(targets)
    both = pose_hands(
        hand, torch.cat([photos.shape, targets.shape]), torch.cat([photos.angles, targets.angles]),
        torch.cat([orientation, place[0]]), torch.cat([translation, place[1]]),
    )  # fmt: skip
    true = PosedHands(*(part[:count] for part in both))
    choice = torch.randint(ALIKE, (count,), generator=random).to(like.device, non_blocking=True)
    if noise.surface == 0:
        seen = EstimatedHands(true.posed, K)
    else:
        errors = bundled_errors(like.device).scaled(noise.surface)
        seen = simulate_estimate(hand, true, photos.shape, photos.angles, orientation, K, errors, choice)
    numbers = torch.randn(count, 1 + MASK_NUMBERS, generator=random).to(like, non_blocking=True)
    mask = cut_at_wrist(mask, alpha, true.landmarks, K, numbers[:, 0], noise.mask)
    crop = crop_to_mask(torch.cat([image, mask[..., None]], dim=-1), mask, seen.K, size)

    alone = goal_image * (goal_mask / goal_alpha.clamp_min(1e-3)).clamp(0, 1)[..., None]  # over black already
    hidden = (goal_alpha - goal_mask).clamp(0, 1)
    cut = crop_to_mask(torch.cat([alone, torch.stack([goal_mask, hidden], -1)], dim=-1), goal_mask, goal_K, size)
    eye = torch.eye(4, dtype=like.dtype, device=like.device)

    def per_hand(tensor: Tensor) -> Tensor:
        return tensor.unflatten(0, (count, views))

    return TrainingBatch(
        image=crop.planes[..., :3].clamp(0, 1),
        mask=perturb_outline(crop.planes[..., 3].clamp(0, 1), numbers[:, 1:], noise.mask),
        posed=seen.posed,
        viewmat=eye.expand(count, -1, -1),
        K=crop.K,
        rest=true.rest,
        target_images=per_hand(cut.planes[..., :3].clamp(0, 1)),
        target_masks=per_hand(cut.planes[..., 3].clamp(0, 1)),
        target_known=per_hand(1 - cut.planes[..., 4].clamp(0, 1)),
        target_posed=per_hand(both.posed[count:]),
        target_viewmats=eye.expand(count, views, -1, -1),
        target_Ks=per_hand(cut.K),
    )
