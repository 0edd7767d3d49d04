"""Fit the colours of a prior's guesses to K photos of one hand; one photo is the case K = 1."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.albedo_split import split_albedo_shading
from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.adaptation.prior_guess import Calibration, calibrate, mix_guesses
from oasis_warp.adaptation.reliability import VertexObservations, observe_photos, photo_gains
from oasis_warp.adaptation.sh_lighting import match_light
from oasis_warp.adaptation.sharpen import sharpen
from oasis_warp.adaptation.skin_tone import with_likely_tone
from oasis_warp.adaptation.texture import Targets, learn_lora, learn_texture, make_targets, reference_azimuths
from oasis_warp.adaptation.unlit import (
    MIN_ALPHA,
    PhotoView,
    picture_of,
    remove_photo_light,
    trust_in_photo,
    unlit_detail,
    view_in_photo,
)
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.observation import inner_mask, observe
from oasis_warp.avatar.pose import in_even_light, shading_factors
from oasis_warp.avatar.vertex_light import posed_lighting
from oasis_warp.avatar.wrist import shade_left
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.network.heads import ColorHeads
from oasis_warp.ops import BlendWeights, blend_colors, stack_weights
from oasis_warp.render import view_weights

SHADING_LENGTH = 0.01
"""Differences between photos that change over a longer distance along the skin may be light and are averaged [m]."""
SHADING_REACH = 0.1
"""Distance over which a photo's shading would be forgotten where the photo says nothing [m]: not within a hand."""
GUESS_LIGHT = 4.0
"""Weight of the prior's guess in the shading, against a photo that sees the place well. On synthetic people in any
light more is better, up to here at least: 4 photos reach 20.8 dB without it, 22.3 with 1, 23.3 with 4."""
UNSEEN = 0.02
"""Weight of a photo's guess where the photo shows nothing, against one that sees the place well."""
DETAIL_SHARPNESS = 2.0
"""Power of a photo's share beside the others' with which its detail counts: two photos' detail does not quite meet."""


class Adaptation(NamedTuple):
    """The fitted Gaussians, in the light of the first photo, and how they came about."""

    gaussians: CanonicalGaussians
    guess: CanonicalGaussians
    """Before adaptation: the guesses of all photos, in one likely tone, mixed."""
    calibration: Calibration
    losses: tuple[float, ...]
    """Loss of each step of texture learning."""
    observations: VertexObservations
    """What the photos show without their lights."""
    gains: Float[Tensor, "K 3"]
    """How much brighter each photo is than the first."""
    shading: Float[Tensor, "K V 3"]
    """What to add to each photo after that, so that photos agree where they show the same place; 0 for one photo."""
    lights: tuple[HandLight, ...] | None
    """In which the Gaussians, times gains, look like the photos; None where light is in the colours, or left out."""
    trust: Float[Tensor, "K V"]
    """How far what each photo shows beyond the guess is skin (`trust_in_albedo`); 1 where the light is kept."""

    @property
    def trusted(self) -> VertexObservations:
        """The observations, of which only what is skin counts."""
        return self.observations._replace(confidence=self.observations.confidence * self.trust)

    @property
    def light(self) -> HandLight | None:
        """The first photo's light."""
        return self.lights[0] if self.lights else None


class _Photos(NamedTuple):
    """K photos, and one guess of the hand as each of them shows it."""

    crops: Sequence[HandCrop]
    """As taken."""
    unlit: Sequence[HandCrop]
    lights: tuple[HandLight, ...] | None
    observations: VertexObservations
    gains: Float[Tensor, "K 3"]
    views: Sequence[PhotoView]
    stacked: BlendWeights
    """Weights of all views, one below the other."""
    pixel_shares: Sequence[Float[Tensor, "S S"]]
    """How far each pixel counts beside the other photos; 0 where the guess does not cover it."""
    trust: Float[Tensor, "K V"]
    """Result of `trust_in_albedo`; 1 where the light is kept."""


def adapt(
    hand: HandModel,
    guesses: Sequence[CanonicalGaussians],
    crops: Sequence[HandCrop],
    config: AdaptConfig = AdaptConfig(),  # noqa: B008 - frozen
    *,
    resolutions: Sequence[float] | None = None,
    heads: ColorHeads | None = None,
    perceptual: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None,
    progress: Progress = silent,
) -> Adaptation:
    """Fit colours to the photos; geometry stays.

    The colours are calibrated, then inpainted beyond the rim of the seen region, then learned with reference views.
    With `config.light` "fit" the first two steps look at photos without their light, and only where they reliably show
    the hand. The last step draws in that light; most of what it learns beyond the prior becomes shade, which goes when
    the hand turns. With "even" other likely light is left out, too, and nothing is learned. With `config.texture`
    "lora" or "full" nothing is inpainted, as in the paper. Several photos count in each pixel by how well they show the
    place.

    Args:
        hand: The model.
        guesses: Guesses of the prior, one for each photo.
        crops: The photos, with one surface at rest, on one device, of one size.
        config: Options.
        resolutions: Pixels of each photo for one pixel of its crop, along a line; 1 if not given.
        heads: Colour heads of the one guess, for these two: see `network.prior.guess_with_heads`.
        perceptual: LPIPS, which the paper's loss of pictures has too; only of one photo.
        progress: Called as work goes on.

    Raises:
        ValueError: one of these without heads, or for several photos.
    """
    lora = _heads_to_train(config, heads, len(crops))
    progress("calibration", 0, 1)
    if heads is None:  # heads that are trained give the colours anew
        guesses = with_likely_tone(hand, guesses, crops)
    guess, photos = _gather(hand, guesses, crops, resolutions, config)
    evenly_exposed = [crop.image / gain for crop, gain in zip(photos.unlit, photos.gains, strict=True)]
    trust = [inner_mask(crop.mask, 1) * share for crop, share in zip(photos.unlit, photos.pixel_shares, strict=True)]
    repeated = guess.colors.repeat(len(crops), 1)
    calibration = calibrate(photos.stacked, repeated, torch.cat(evenly_exposed), torch.cat(trust), config)
    calibrated = gaussians = guess._replace(colors=calibration.apply(guess.colors))
    progress("calibration", 1, 1)
    shading = torch.zeros_like(photos.observations.colors)
    if lora is None:
        progress("completion", 0, 1)
        gaussians, shading = _complete(hand, photos, calibrated, evenly_exposed, config)
        progress("completion", 1, 1)
    result = Adaptation(
        gaussians, guess, calibration, (), photos.observations, photos.gains, shading, photos.lights,
        photos.trust,
    )  # fmt: skip
    if config.light == "even" and photos.lights:  # all that is left to learn is light
        return result._replace(gaussians=in_even_light(gaussians, photos.lights[0]), lights=None)
    targets = _texture_targets(hand, photos, gaussians, shading, config)._replace(perceptual=perceptual)
    if lora is None:
        texture = learn_texture(gaussians, hand.faces.to(shading.device), targets, config, progress)
    else:
        texture = learn_lora(lora, calibration, targets, config, progress)
    gaussians = gaussians._replace(colors=texture.colors)
    if photos.lights is not None:
        weight = photos.observations.confidence * photos.observations.share
        trusted = (weight * photos.trust).sum(0)
        trust = trusted / (weight.sum(0) + UNSEEN)
        hand_share = shade_left(hand, crops[0].rest.vertices)[:, 0]
        gaussians = split_albedo_shading(hand, calibrated.colors, gaussians, trust, hand_share, trusted + UNSEEN)
    return result._replace(gaussians=gaussians, losses=texture.losses)


def _heads_to_train(config: AdaptConfig, heads: ColorHeads | None, n_photos: int) -> ColorHeads | None:
    of_heads, name = config.texture != "field", f"texture {config.texture!r}"
    if of_heads and n_photos > 1:
        raise ValueError(f"{name}: is for one photo, got {n_photos}. Choose 'field'.")
    if of_heads and heads is None:
        raise ValueError(f"{name}: expected the heads of the prior, got none. Ask it with guess_with_heads.")
    return heads if of_heads and config.light != "even" else None


def add_detail(
    hand: HandModel,
    adaptation: Adaptation,
    crops: Sequence[HandCrop],
    resolutions: Sequence[float],
    size: int,
    progress: Progress = silent,
) -> Adaptation:
    """The adaptation with finer Gaussians. Each place takes its detail from the photo that shows it best.

    Args:
        hand: The model.
        adaptation: To these photos.
        crops: The photos again, as large as their detail.
        resolutions: Resolutions of these crops; see `adapt`.
        size: Side of the crops that were adapted to [px]. A photo whose crop is no larger has no detail to give, and no
            other photo gives any where it is the best.
        progress: Called as the colours are fitted.
    """
    if all(len(crop.image) <= size for crop in crops):
        return adaptation
    gaussians, lights = adaptation.gaussians, adaptation.lights or [None] * len(crops)
    unlit, finer, trust = [], [], []
    for k, (crop, light, gain) in enumerate(zip(crops, lights, adaptation.gains, strict=True)):
        as_bright = gaussians._replace(colors=gaussians.colors * gain)
        weights = view_in_photo(hand, gaussians, crop).weights
        shown, trusted = unlit_detail(hand, as_bright, crop, weights, light, several=len(crops) > 1)
        unlit.append(shown)
        if len(crop.image) > size:
            trust.append(trusted)
            if len(crops) == 1:
                fine = sharpen(hand, gaussians, crops, None, torch.stack(trust), light, progress).gaussians
                return adaptation._replace(gaussians=fine)
            image = _in_first_light(hand, unlit[k].image, weights, gaussians, gain, adaptation.shading[k])
            finer.append((k, unlit[k]._replace(image=image)))
    share = observe_photos(hand, unlit, resolutions).share ** DETAIL_SHARPNESS
    share = share / share.sum(0)
    indices, pictures = zip(*finer, strict=True)
    fine = sharpen(hand, gaussians, pictures, share[list(indices)], torch.stack(trust), None, progress).gaussians
    return adaptation._replace(gaussians=fine)


def light_factors(
    hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, light: HandLight
) -> Float[Tensor, "N 3"]:
    """Factors by which the light of a photo multiplies the colours of `gaussians`."""
    rest, faces = crop.rest.vertices, hand.faces.to(crop.image.device)
    return shading_factors(gaussians, faces, light, posed_lighting(rest, crop.posed.vertices, faces, light))


def _gather(
    hand: HandModel,
    guesses: Sequence[CanonicalGaussians],
    crops: Sequence[HandCrop],
    resolutions: Sequence[float] | None,
    config: AdaptConfig,
) -> tuple[CanonicalGaussians, _Photos]:
    """The mixed guess, and the photos without their lights."""
    views = [view_in_photo(hand, guess, crop) for guess, crop in zip(guesses, crops, strict=True)]
    read = [
        remove_photo_light(hand, guess, crop, view.weights, config)
        for guess, crop, view in zip(guesses, crops, views, strict=True)
    ]
    unlit, faces = [photo.crop for photo in read], hand.faces.to(crops[0].image.device)
    seen = observe_photos(hand, unlit, resolutions or [1.0] * len(crops))
    guess = mix_guesses(guesses, seen.confidence * seen.share + UNSEEN, faces)
    if guess is not guesses[0]:
        views = [view_in_photo(hand, guess, crop) for crop in crops]
    pixel_shares = []
    for view, share in zip(views, seen.share, strict=True):
        others = blend_colors(view.weights, vertex_to_gaussians(1 - share[:, None], faces, guess))
        alphas = view.weights.alphas
        pixel_shares.append(((1 - others / alphas.clamp_min(MIN_ALPHA)) * (alphas > 0.5))[..., 0])
    lights = tuple(photo.light for photo in read if photo.light is not None) or None
    gains = photo_gains(seen, vertex_colors(guess, len(hand.template)))
    stacked = stack_weights([view.weights for view in views])
    trust = torch.stack([trust_in_photo(hand, crop, photo) for crop, photo in zip(crops, read, strict=True)])
    return guess, _Photos(crops, unlit, lights, seen, gains, views, stacked, pixel_shares, trust)


def _complete(
    hand: HandModel,
    photos: _Photos,
    gaussians: CanonicalGaussians,
    pictures: Sequence[Float[Tensor, "S S 3"]],
    config: AdaptConfig,
) -> tuple[CanonicalGaussians, Float[Tensor, "K V 3"]]:
    """Calibrated Gaussians, inpainted from what the photos show of them, and `Adaptation.shading`.

    `pictures` are the photos without their lights, as bright as the first.
    """
    seen, views = photos.observations, photos.views
    rest, faces = photos.crops[0].rest.vertices, hand.faces.to(seen.colors.device)
    # Not the Gaussians' own colours: those of a learned prior need not agree where they overlap.
    drawn = [picture_of(view.weights, gaussians.colors) for view in views]

    def differences() -> Float[Tensor, "K V 3"]:
        return torch.stack([
            observe(hand, crop._replace(image=picture - own)).colors
            for crop, picture, own in zip(photos.unlit, pictures, drawn, strict=True)
        ])  # fmt: skip

    missing, shading = differences(), torch.zeros_like(seen.colors)
    if len(views) > 1:
        shading = _shading_corrections(hand, rest, missing, seen.confidence)
        pictures = [
            _in_first_light(hand, crop.image, view.weights, gaussians, gain, own)
            for crop, view, gain, own in zip(photos.unlit, views, photos.gains, shading, strict=True)
        ]
        missing = differences()
    if config.light == "even":
        pictures = [
            match_light(picture, own, *at_vertices, view.weights, gaussians, rest, faces)
            for picture, own, view, *at_vertices in zip(pictures, drawn, views, missing, seen.confidence, strict=True)
        ]
        missing = differences()
    weight = seen.confidence * seen.share * photos.trust
    missing = ((weight / weight.sum(0).clamp_min(1e-12))[..., None] * missing).sum(0)
    change = vertex_to_gaussians(inpaint(rest, faces, missing, weight.amax(0)), faces, gaussians)
    return gaussians._replace(colors=(gaussians.colors + change).clamp(0, 1)), shading


def _texture_targets(
    hand: HandModel, photos: _Photos, gaussians: CanonicalGaussians, shading: Tensor, config: AdaptConfig
) -> Targets:
    """The photos one below the other, each in its own light, and reference views around the first.

    The photos are not divided by a picture of their light: that would be wrong where two fingers share a pixel.
    """
    first, faces = photos.crops[0], hand.faces.to(shading.device)
    references = [
        view_weights(photos.views[0].posed, orbit_camera(first.posed.vertices, azimuth, size=first.camera.width))
        for azimuth in reference_azimuths(config.reference_views)
    ]
    mask = [c.mask * inner_mask(c.mask, 1) * own for c, own in zip(photos.crops, photos.pixel_shares, strict=True)]
    factors, pictures = [], []
    for k, (crop, view) in enumerate(zip(photos.crops, photos.views, strict=True)):
        factor = photos.gains[k].expand_as(gaussians.colors)
        if photos.lights is not None:
            factor = factor * light_factors(hand, gaussians, crop, photos.lights[k])
        factors.append(factor)
        pictures.append(
            crop.image + blend_colors(view.weights, factor * vertex_to_gaussians(shading[k], faces, gaussians))
        )
    return make_targets(
        photos.stacked, torch.cat(pictures), torch.cat(mask), references, gaussians.colors, torch.stack(factors)
    )


def _in_first_light(
    hand: HandModel, photo: Float[Tensor, "S S 3"], weights: BlendWeights, gaussians: CanonicalGaussians, gain: Tensor,
    shading: Float[Tensor, "V 3"],
) -> Float[Tensor, "S S 3"]:  # fmt: skip
    """The photo in the light of the first: without its gain, and with its shading correction as `weights` draw it."""
    own = vertex_to_gaussians(shading, hand.faces.to(photo.device), gaussians)
    return photo / gain + blend_colors(weights, own) / weights.alphas.clamp_min(MIN_ALPHA)


def _shading_corrections(
    hand: HandModel, rest: Float[Tensor, "V 3"], differences: Float[Tensor, "K V 3"], confidence: Float[Tensor, "K V"]
) -> Float[Tensor, "K V 3"]:
    """Smooth corrections to each photo, so that photos agree wherever two show the same place.

    Every photo has its lamps elsewhere, and fingers shade each other. No photo is right about that, so all move to the
    mean of their differences from the guess; the guess itself is one of them. Detail stays with the photo that shows it
    best.
    """
    smooth = torch.stack([
        inpaint(rest, hand.faces, own, seen, detail=SHADING_LENGTH, fade=SHADING_REACH)
        for own, seen in zip(differences, confidence, strict=True)
    ])  # fmt: skip
    mean = (confidence[..., None] * smooth).sum(0) / (confidence.sum(0) + GUESS_LIGHT)[:, None]
    return torch.where(confidence[..., None] > 0, mean - smooth, 0.0)
