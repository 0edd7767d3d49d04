"""One-shot adaptation: a prior's guess becomes the hand of one photo."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.calibrate import Calibration, calibrate
from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.adaptation.reliability import mask_unreliable
from oasis_warp.adaptation.sh_lighting import (
    apply_light,
    even_photo,
    fit_light,
    split_albedo_shading,
    with_shade,
    without_light,
)
from oasis_warp.adaptation.texture import aim, learn_lora, learn_texture, reference_azimuths
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.observation import inner_mask, observe
from oasis_warp.avatar.pose import factors, in_even_light, pose_gaussians, posed_normals
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import CanonicalGaussians, Gaussians, HandCrop, HandLight
from oasis_warp.network.heads import ColorHeads
from oasis_warp.ops import BlendWeights, blend_colors
from oasis_warp.render.render import view_weights

MIN_ALPHA = 0.05
"""Below it a pixel says nothing about the colour of the hand."""


class Adaptation(NamedTuple):
    """The fitted Gaussians and how they came about."""

    gaussians: CanonicalGaussians
    calibration: Calibration
    losses: tuple[float, ...]
    """Of texture learning, a step each."""
    light: HandLight | None
    """In which the Gaussians look like the photo; None where that is in their colours, or left out."""


class InPhoto(NamedTuple):
    """Gaussians as a photo shows them."""

    posed: Gaussians
    view: BlendWeights
    trusted: Float[Tensor, "H W"]
    """1 where the photo's colours are those of the hand."""


def in_photo(hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop) -> InPhoto:
    """Pose `gaussians` as in the photo and blend them once."""
    faces = hand.faces.to(crop.image.device)
    posed = pose_gaussians(gaussians, faces, crop.rest.vertices, crop.posed.vertices)
    view = view_weights(posed, crop.camera)
    return InPhoto(posed, view, _trusted(view, crop))


def _trusted(view: BlendWeights, crop: HandCrop) -> Float[Tensor, "H W"]:
    return inner_mask(crop.mask, 1) * (view.alphas[..., 0] > 0.5)


def adapt(
    hand: HandModel,
    prior: CanonicalGaussians,
    crop: HandCrop,
    config: AdaptConfig = AdaptConfig(),  # noqa: B008 - frozen
    progress: Progress = silent,
    heads: ColorHeads | None = None,
) -> Adaptation:
    """Fit the colours of `prior` to the photo; geometry stays.

    Colour calibration first, then the seen colours are carried smoothly over the rim of the seen region, then texture
    learning with reference views. With `config.light` "fit" the first two look at the photo without its light, where
    it surely shows the hand, the last draws colours in that light, and of what they learned beyond the prior most is
    shade, which goes when the hand turns. With "even" what else may be light is left out, too, and the last step falls
    away. With `config.texture` "lora" texture learning follows upon calibration, as in the
    paper.

    Args:
        hand: The model.
        prior: The whole hand, guessed.
        crop: The photo.
        config: What to do.
        progress: Called as work goes on.
        heads: Those that the colours of `prior` come from, for "lora": see `network.prior.guess_with_heads`.

    Raises:
        ValueError: "lora" without heads.
    """
    if config.texture == "lora" and heads is None:
        raise ValueError("texture 'lora': expected the heads of the prior, got none. Ask it with guess_with_heads.")
    trained = heads if config.texture == "lora" and config.light != "even" else None
    faces = hand.faces.to(crop.image.device)
    posed, view, _ = in_photo(hand, prior, crop)

    progress("calibration", 0, 1)
    photo = crop
    crop, light = _read(hand, prior, photo, view, config)
    trusted = _trusted(view, crop)
    calibration = _calibration(prior, view, crop, trusted, config)
    gaussians = prior._replace(colors=calibration.apply(prior.colors))
    progress("calibration", 1, 1)

    if trained is None:
        progress("completion", 0, 1)
        gaussians = _complete(hand, gaussians, crop, view, config)
        progress("completion", 1, 1)
    if config.light == "even":  # what is left to learn is the photo's light
        return Adaptation(in_even_light(gaussians, light) if light else gaussians, calibration, (), None)
    references = [
        view_weights(posed, orbit_camera(crop.posed.vertices, azimuth, size=crop.camera.width))
        for azimuth in reference_azimuths(config.reference_views)
    ]
    shown = photo.mask * _trusted(view, photo)
    shining = None if light is None else light_factors(hand, gaussians, photo, light)[None]
    pictures = aim(view, photo.image, shown, references, gaussians.colors, shining)
    if trained is None:
        texture = learn_texture(gaussians, faces, pictures, config, progress)
    else:
        texture = learn_lora(trained, calibration, pictures, config, progress)
    gaussians = gaussians._replace(colors=texture.colors)
    if light is not None:
        gaussians = split_albedo_shading(hand, calibration.apply(prior.colors), gaussians)
    return Adaptation(gaussians, calibration, texture.losses, light)


class Reading(NamedTuple):
    """A photo as the skin is read from it."""

    crop: HandCrop
    """As in even light, its mask where it surely shows what the surface has there. The photo itself with "keep"."""
    light: HandLight | None
    """Of the photo; None where it is kept."""


def remove_photo_light(hand: HandModel, prior: CanonicalGaussians, crop: HandCrop, config: AdaptConfig) -> Reading:
    """What `adapt` takes of a photo."""
    return _read(hand, prior, crop, in_photo(hand, prior, crop).view, config)


def _read(
    hand: HandModel, prior: CanonicalGaussians, crop: HandCrop, view: BlendWeights, config: AdaptConfig
) -> Reading:
    def drawn(crop: HandCrop) -> Tensor:
        calibration = _calibration(prior, view, crop, _trusted(view, crop), config)
        return _drawn(view, calibration.apply(prior.colors))

    if config.light == "keep":
        return Reading(crop, None)
    # The shaded side of a hand before a dark wall is no wall: what is sure is judged in a first guess of the light.
    picture = drawn(crop)
    sure = mask_unreliable(hand, apply_light(hand, picture, crop, fit_light(hand, picture, crop)), crop)
    light = fit_light(hand, drawn(sure), sure)
    light = with_shade(hand, drawn(without_light(hand, sure, light)), crop, sure, light)
    return Reading(without_light(hand, sure, light), light)


def light_factors(
    hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, light: HandLight
) -> Float[Tensor, "N 3"]:
    """What the light of a photo multiplies the colours of `gaussians` with in it."""
    rest, faces = crop.rest.vertices, hand.faces.to(crop.image.device)
    return factors(gaussians, faces, light, posed_normals(rest, crop.posed.vertices, faces))


def detail_of(
    hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, light: HandLight | None
) -> HandCrop:
    """What a photo, perhaps a larger one than was adapted to, shows of the skin of `gaussians`.

    As `remove_photo_light`: in even light, its mask where it surely shows what the surface has there. The photo itself
    where there is no light apart.
    """
    if light is None:
        return crop
    skin = in_photo(hand, gaussians, crop).view
    lit = apply_light(hand, _drawn(skin, gaussians.colors), crop, light._replace(shade=None))
    return without_light(hand, mask_unreliable(hand, lit, crop), light)


def _complete(
    hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, view: BlendWeights, config: AdaptConfig
) -> CanonicalGaussians:
    """Calibrated Gaussians with what the photo shows of them, faded out around it."""
    faces = hand.faces.to(crop.image.device)
    drawn = _drawn(view, gaussians.colors)  # not the Gaussians' own colours: those of a learned prior need not agree
    missing = observe(hand, crop._replace(image=crop.image - drawn))
    if config.light == "even":
        even = even_photo(crop.image, drawn, missing, view, gaussians, crop.rest.vertices, faces)
        missing = observe(hand, crop._replace(image=even - drawn))
    difference = inpaint(crop.rest.vertices, faces, missing.colors, missing.confidence)
    colors = (gaussians.colors + vertex_to_gaussians(difference, faces, gaussians)).clamp(0, 1)
    return gaussians._replace(colors=colors)


def _calibration(
    prior: CanonicalGaussians, view: BlendWeights, crop: HandCrop, trusted: Tensor, config: AdaptConfig
) -> Calibration:
    if config.calibration == "on":
        return calibrate(view, prior.colors, crop.image, trusted, config)
    return Calibration(torch.ones_like(prior.colors[0]), torch.zeros_like(prior.colors[0]))


@torch.no_grad()
def _drawn(view: BlendWeights, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 3"]:
    """The picture without its background."""
    return blend_colors(view, colors) / view.alphas.clamp_min(MIN_ALPHA)
