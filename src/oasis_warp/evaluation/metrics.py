"""How near a drawn picture comes to the true one: the paper's columns, and the parts of a hand apart."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from oasis_warp.avatar.observation import inner_mask
from oasis_warp.losses.image import ssim_map
from oasis_warp.pretraining.objective import Perceptual

FEWEST_PIXELS = 50
"""Of a part of the hand, else nothing is said about it."""
ERROR_FLOOR = 1e-12
"""Mean squared error that counts as none: 120 dB."""

Scores = dict[str, float | None]
"""By name of the measure; None where there is nothing to measure, or nothing to measure it with."""
MEASURES = (
    "psnr", "psnr_inner", "ssim", "ssim_box", "ssim_mask", "lpips", "psnr_visible", "psnr_hidden", "psnr_stretched",
    "psnr_squeezed", "psnr_unchanged",
)  # fmt: skip


class Truth(NamedTuple):
    """One target as it must come out."""

    image: Float[Tensor, "H W 3"]
    """Over black, times `mask`."""
    mask: Float[Tensor, "H W"]
    """Share of each pixel that is hand."""
    known: Float[Tensor, "H W"]
    """0 where something else may hide the hand: a drawn picture is not judged there."""
    hidden: Bool[Tensor, "H W"]
    """Whether the photo does not show this place of the surface."""
    stretched: Bool[Tensor, "H W"]
    """Whether the pose has stretched the skin there."""
    squeezed: Bool[Tensor, "H W"]
    """Or squeezed it, as inside bent joints: folds, darker than any colour that skin has at rest."""


def score(image: Float[Tensor, "H W 3"], truth: Truth, perceptual: Perceptual | None = None) -> Scores:
    """Measure `image`, drawn over black, by every one of `MEASURES`.

    PSNR [dB] weighs pixels by the mask; the inner one, and those of parts, leave out two pixels at the outline, where
    shape decides and not skin. SSIM is the mean over the whole picture, over the mask's box, and over the mask. LPIPS
    is of the hand alone.
    """
    drawn = image.clamp(0, 1) * truth.known[..., None]
    mask, error = truth.mask, (drawn - truth.image).square().mean(-1)
    inner = mask * (inner_mask(mask) > 0.5)
    similarity = ssim_map(drawn, truth.image)
    rows, columns = (torch.nonzero((mask > 0.5).any(axis))[:, 0] for axis in (1, 0))
    scores: Scores = {
        "psnr": _psnr(error, mask),
        "psnr_inner": _psnr(error, inner),
        "ssim": float(similarity.mean()),
        "ssim_box": None,
        "ssim_mask": float((similarity * mask).sum() / mask.sum().clamp_min(1)),
        "lpips": None,
    }
    if len(rows):
        box = similarity[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
        scores["ssim_box"] = float(box.mean())
    if perceptual is not None:
        scores["lpips"] = float(perceptual(drawn[None], truth.image[None], mask[None])[0])
    for name, part in {
        "visible": ~truth.hidden,
        "hidden": truth.hidden,
        "stretched": truth.stretched,
        "squeezed": truth.squeezed,
        "unchanged": ~(truth.stretched | truth.squeezed),
    }.items():
        scores[f"psnr_{name}"] = _psnr(error, inner * part)
    return scores


def _psnr(error: Tensor, weight: Tensor) -> float | None:
    total = float(weight.sum())
    if total < FEWEST_PIXELS:
        return None
    return -10 * math.log10(max(float((error * weight).sum()) / total, ERROR_FLOOR))


def color_gain(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, "3"]:
    """The gain of each channel that brings `image` nearest to `target` inside `mask` (least squares).

    A photo does not tell a coloured hand from coloured light, and what it is compared with stands in another light.
    """
    weighted = image * mask[..., None]
    return (weighted * target).sum((0, 1)) / (weighted * image).sum((0, 1)).clamp_min(1e-6)


def match_colors(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """`image` after `color_gain`, kept in [0, 1]."""
    return (image * color_gain(image, target, mask)).clamp(0, 1)
