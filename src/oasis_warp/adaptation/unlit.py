"""Photos without their light: Gaussians as a photo shows them, and the skin as it is read from a photo."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.prior_guess import calibrate
from oasis_warp.adaptation.reliability import mask_unreliable
from oasis_warp.adaptation.sh_lighting import add_shade, apply_light, fit_light, trust_in_albedo, without_light
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, Gaussians, HandCrop, HandLight
from oasis_warp.ops import BlendWeights, blend_colors
from oasis_warp.render import view_weights

MIN_ALPHA = 0.05
"""Below it a pixel says nothing about the colour of the hand."""


class PhotoView(NamedTuple):
    """Gaussians as a photo shows them."""

    posed: Gaussians
    weights: BlendWeights
    trusted: Float[Tensor, "H W"]
    """1 where the photo's colours are those of the hand."""


def view_in_photo(hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop) -> PhotoView:
    """Pose `gaussians` as in the photo and blend them once."""
    faces = hand.faces.to(crop.image.device)
    posed = pose_gaussians(gaussians, faces, crop.rest.vertices, crop.posed.vertices)
    weights = view_weights(posed, crop.camera)
    return PhotoView(posed, weights, _trusted(weights, crop))


def _trusted(weights: BlendWeights, crop: HandCrop) -> Float[Tensor, "H W"]:
    return inner_mask(crop.mask, 1) * (weights.alphas[..., 0] > 0.5)


@torch.no_grad()
def picture_of(weights: BlendWeights, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 3"]:
    """The picture without its background."""
    return blend_colors(weights, colors) / weights.alphas.clamp_min(MIN_ALPHA)


class Unlit(NamedTuple):
    """A photo as the skin is read from it."""

    crop: HandCrop
    """As in even light, its mask where the photo surely shows the surface. The photo itself with the light "keep"."""
    light: HandLight | None
    """Light of the photo; None where it is kept."""


def remove_photo_light(
    hand: HandModel, guess: CanonicalGaussians, crop: HandCrop, weights: BlendWeights, config: AdaptConfig
) -> Unlit:
    """Fit the light of one photo and remove it.

    Reliable pixels are found in a first guess of the light; otherwise the shaded side of a hand would count as the dark
    wall behind it.

    Args:
        hand: The model.
        guess: What the prior makes of the photo.
        crop: The photo.
        weights: Weights of `guess` in the photo.
        config: Options.
    """

    def calibrated_picture(crop: HandCrop) -> Tensor:
        calibration = calibrate(weights, guess.colors, crop.image, _trusted(weights, crop), config)
        return picture_of(weights, calibration.apply(guess.colors))

    if config.light == "keep":
        return Unlit(crop, None)
    picture = calibrated_picture(crop)
    reliable = mask_unreliable(hand, apply_light(hand, picture, crop, fit_light(hand, picture, crop)), crop)
    light = fit_light(hand, calibrated_picture(reliable), reliable)
    light = add_shade(hand, calibrated_picture(without_light(hand, reliable, light)), crop, reliable, light)
    return Unlit(without_light(hand, reliable, light), light)


def unlit_detail(
    hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, weights: BlendWeights, light: HandLight | None,
    *, several: bool = False,
) -> tuple[HandCrop, Float[Tensor, "V"]]:  # fmt: skip
    """What a photo shows of the skin of `gaussians`, in even light, and its `trust_in_albedo`.

    The photo may be larger than the one that was adapted to. It is returned as it is where no light is separated. With
    `several` photos all pixels count: with reliable pixels only, a second photo's detail reduces the error less.
    """
    if light is None:
        return crop, crop.rest.vertices.new_ones(len(crop.rest.vertices))
    sure = crop
    if not several:
        lit = apply_light(hand, picture_of(weights, gaussians.colors), crop, light._replace(shade=None))
        sure = mask_unreliable(hand, lit, crop)
    return without_light(hand, crop, light), trust_in_albedo(hand, crop, sure, light)


def trust_in_photo(hand: HandModel, crop: HandCrop, photo: Unlit) -> Float[Tensor, "V"]:
    """`trust_in_albedo`, 1 where light is kept."""
    if photo.light is None:
        return crop.rest.vertices.new_ones(len(crop.rest.vertices))
    return trust_in_albedo(hand, crop, photo.crop, photo.light)
