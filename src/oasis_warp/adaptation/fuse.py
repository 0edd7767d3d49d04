"""One avatar of several photos: their guesses mixed, their light made one, and one adaptation to all of them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.adapt import MIN_ALPHA, Reading, adapt, in_photo, light_factors, remove_photo_light
from oasis_warp.adaptation.calibrate import calibrate
from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.adaptation.reliability import VertexObservations, look, photo_gains
from oasis_warp.adaptation.sh_lighting import even_photo, split_albedo_shading, without_light
from oasis_warp.adaptation.sharpen import sharpen
from oasis_warp.adaptation.texture import aim, learn_texture, reference_azimuths
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.mixture import mix_guesses
from oasis_warp.avatar.observation import Observation, inner_mask, observe
from oasis_warp.avatar.pose import in_even_light, pose_gaussians
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.ops import BlendWeights, blend_colors, stack_weights
from oasis_warp.render.render import view_weights

SHADING_LENGTH = 0.01
"""What changes over a longer way along the skin may be light, and photos meet halfway in it [m]."""
REACH = 0.1
"""Way over which a photo's shading would be forgotten where the photo says nothing [m]: not within a hand."""
GUESS_LIGHT = 4.0
"""Weight of the prior's guess in the shading, against a photo that sees the place well. On synthetic people in any
light more is better, up to here at least: 4 photos come to 20.8 dB without it, 22.3 with 1, 23.3 with 4."""
UNSEEN = 0.02
"""Weight of a photo's guess where the photo shows nothing, against one that sees the place well."""
DETAIL_SHARPNESS = 2.0
"""Power of a photo's share beside the others' with which its detail counts: two photos' detail does not quite meet."""


class Fusion(NamedTuple):
    """The Gaussians of all photos, in the light of the first, and how they came about."""

    gaussians: CanonicalGaussians
    guess: CanonicalGaussians
    """Before adaptation: the prior's guesses of all photos, mixed."""
    sightings: VertexObservations
    gains: Float[Tensor, "K 3"]
    """How much brighter each photo is than the first."""
    shading: Float[Tensor, "K V 3"]
    """What to add to each photo then, so that photos agree where they show the same place."""
    lights: tuple[HandLight, ...] | None
    """In which the Gaussians, times gains, look like the photos; None where light is in the colours, or left out."""


def fuse(
    hand: HandModel,
    crops: Sequence[HandCrop],
    resolution: Sequence[float],
    guesses: Sequence[CanonicalGaussians],
    config: AdaptConfig = AdaptConfig(),  # noqa: B008 - frozen
    progress: Progress = silent,
) -> Fusion:
    """Make one hand of K photos; of one, what `adaptation.adapt.adapt` makes of it.

    Args:
        hand: The model.
        crops: All with one surface at rest, on one device, of one size.
        resolution: See `sightings.look`.
        guesses: What the prior makes of every photo.
        config: Of the adaptation.
        progress: Told of the adaptation's steps.

    Raises:
        ValueError: `config.texture` is "lora": the heads of several guesses have no common colours to train.
    """
    if config.texture == "lora":
        raise ValueError("texture 'lora': is for one photo, got several to fuse. Choose 'field'.")
    if len(guesses) == 1:
        made = adapt(hand, guesses[0], crops[0], config, progress)
        sightings = look(hand, crops, resolution)
        gains, shading = torch.ones_like(sightings.colors[:, 0]), torch.zeros_like(sightings.colors)
        return Fusion(made.gaussians, guesses[0], sightings, gains, shading, made.light and (made.light,))
    photos = crops
    readings = [remove_photo_light(hand, guess, crop, config) for guess, crop in zip(guesses, crops, strict=True)]
    crops = [reading.crop for reading in readings]
    lights = tuple(reading.light for reading in readings if reading.light) or None
    sightings = look(hand, crops, resolution)
    faces = hand.faces.to(crops[0].image.device)
    guess = mix_guesses(guesses, sightings.confidence * sightings.share + UNSEEN, faces)
    gains = photo_gains(sightings, vertex_colors(guess, len(hand.template)))
    made, shading, calibrated = _adapt(hand, guess, photos, readings, sightings, gains, config, progress)
    if lights is not None and config.light == "even":
        made, lights = in_even_light(made, lights[0]), None
    elif lights is not None:
        made = split_albedo_shading(hand, calibrated, made)
    return Fusion(made, guess, sightings, gains, shading, lights)


def unlit(
    hand: HandModel, crops: Sequence[HandCrop], lights: Sequence[HandLight] | None
) -> Sequence[HandCrop]:
    """The photos without their lights, where these are known apart from the skin."""
    if lights is None:
        return crops
    return [without_light(hand, *pair) for pair in zip(crops, lights, strict=True)]


def add_detail(
    hand: HandModel,
    fusion: Fusion,
    crops: Sequence[HandCrop],
    resolution: Sequence[float],
    size: int,
    progress: Progress = silent,
) -> CanonicalGaussians:
    """The Gaussians of `fusion`, with finer ones that show each place as the photo does that shows it best.

    Args:
        hand: The model.
        fusion: Of these photos.
        crops: The photos again, as large as their detail.
        resolution: Of these; see `sightings.look`.
        size: Side of the crops that were fused [px]. A photo whose crop is no larger has no detail to give, and no
            other photo gives any where it is the best.
        progress: Told of the colours' fit.
    """
    crops = unlit(hand, crops, fusion.lights)
    share = look(hand, crops, resolution).share ** DETAIL_SHARPNESS
    share = share / share.sum(0)
    finer = [k for k, crop in enumerate(crops) if len(crop.image) > size]
    lit = []
    for k in finer:
        view = in_photo(hand, fusion.gaussians, crops[k]).view
        image = _in_first_light(hand, crops[k].image, view, fusion.gaussians, fusion.gains[k], fusion.shading[k])
        lit.append(crops[k]._replace(image=image))
    return sharpen(hand, fusion.gaussians, lit, share[finer], progress).gaussians


def _adapt(
    hand: HandModel, guess: CanonicalGaussians, photos: Sequence[HandCrop], readings: Sequence[Reading],
    sightings: VertexObservations, gains: Tensor, config: AdaptConfig, progress: Progress,
) -> tuple[CanonicalGaussians, Float[Tensor, "K V 3"], Float[Tensor, "N 3"]]:  # fmt: skip
    """The steps of `adaptation.adapt.adapt`, on all photos at once: their pictures stand below each other as one.

    A pixel counts as much as its photo is to be believed there. `readings` are what `remove_photo_light`
    takes of `photos`. With the Gaussians come `Fusion.shading` and the colours that the guess had after calibration.
    """
    crops = [reading.crop for reading in readings]
    first = crops[0]
    faces, rest = hand.faces.to(first.image.device), first.rest.vertices
    posed = [pose_gaussians(guess, faces, e.rest.vertices, e.posed.vertices) for e in crops]
    views = [view_weights(there, crop.camera) for there, crop in zip(posed, crops, strict=True)]
    lit = [crop.image / gain for crop, gain in zip(crops, gains, strict=True)]
    believed = []
    for view, share in zip(views, sightings.share, strict=True):
        drawn = blend_colors(view, vertex_to_gaussians(share[:, None], faces, guess))
        believed.append((drawn / view.alphas.clamp_min(MIN_ALPHA) * (view.alphas > 0.5))[..., 0])
    tall = stack_weights(views)
    trust = torch.cat([inner_mask(e.mask, 1) * own for e, own in zip(crops, believed, strict=True)])

    progress("calibration", 0, 1)
    if config.calibration == "on":
        everywhere = guess.colors.repeat(len(views), 1)
        guess = guess._replace(colors=calibrate(tall, everywhere, torch.cat(lit), trust, config).apply(guess.colors))
    calibrated = guess.colors
    progress("calibration", 1, 1)

    progress("completion", 0, 1)
    weight = sightings.confidence * sightings.share
    drawn = [blend_colors(view, guess.colors) / view.alphas.clamp_min(MIN_ALPHA) for view in views]

    def differences() -> Tensor:
        return torch.stack([
            observe(hand, crop._replace(image=photo - picture)).colors
            for crop, photo, picture in zip(crops, lit, drawn, strict=True)
        ])  # fmt: skip

    shading = _other_shading(hand, rest, differences(), sightings.confidence)
    lit = [
        _in_first_light(hand, crop.image, view, guess, gain, other)
        for crop, view, gain, other in zip(crops, views, gains, shading, strict=True)
    ]
    if config.light == "even":
        lit = [
            even_photo(photo, picture, Observation(own, seen), view, guess, rest, faces)
            for photo, picture, own, seen, view in zip(
                lit, drawn, differences(), sightings.confidence, views, strict=True
            )
        ]
    missing = (weight[..., None] * differences()).sum(0) / weight.sum(0).clamp_min(1e-12)[:, None]
    difference = inpaint(rest, faces, missing, weight.amax(0))
    guess = guess._replace(colors=(guess.colors + vertex_to_gaussians(difference, faces, guess)).clamp(0, 1))
    progress("completion", 1, 1)
    if config.light == "even":  # what is left to learn is the photos' light
        return guess, shading, calibrated

    references = [
        view_weights(posed[0], orbit_camera(first.posed.vertices, azimuth, size=first.camera.width))
        for azimuth in reference_azimuths(config.reference_views)
    ]
    mask = torch.cat([e.mask * inner_mask(e.mask, 1) * own for e, own in zip(photos, believed, strict=True)])
    # In each photo's own light: divided by a picture of it, photos would be wrong where two fingers share a pixel.
    lights, targets = [], []
    for photo, reading, gain, other, view in zip(photos, readings, gains, shading, views, strict=True):
        light = gain.expand_as(guess.colors)
        light = light if reading.light is None else light * light_factors(hand, guess, photo, reading.light)
        lights.append(light)
        targets.append(photo.image + blend_colors(view, light * vertex_to_gaussians(other, faces, guess)))
    pictures = aim(tall, torch.cat(targets), mask, references, guess.colors, torch.stack(lights))
    texture = learn_texture(guess, faces, pictures, config, progress)
    return guess._replace(colors=texture.colors), shading, calibrated


def _in_first_light(
    hand: HandModel, photo: Float[Tensor, "S S 3"], view: BlendWeights, gaussians: CanonicalGaussians, gain: Tensor,
    shading: Float[Tensor, "V 3"],
) -> Float[Tensor, "S S 3"]:  # fmt: skip
    """The photo without what its light has of its own, drawn by the `gaussians` of `view`."""
    own = vertex_to_gaussians(shading, hand.faces.to(photo.device), gaussians)
    return photo / gain + blend_colors(view, own) / view.alphas.clamp_min(MIN_ALPHA)


def _other_shading(
    hand: HandModel, rest: Float[Tensor, "V 3"], differences: Float[Tensor, "K V 3"], confidence: Float[Tensor, "K V"]
) -> Float[Tensor, "K V 3"]:
    """What to add to each photo, smoothly over the skin, so that photos agree wherever two show the same place.

    Lamps stand elsewhere in every photo, and fingers shade each other. No photo is right about it: they meet at the
    mean of what each differs from the guess, the guess itself among them. Detail stays with the photo that shows it
    best.
    """
    smooth = torch.stack([
        inpaint(rest, hand.faces, own, seen, detail=SHADING_LENGTH, fade=REACH)
        for own, seen in zip(differences, confidence, strict=True)
    ])  # fmt: skip
    mean = (confidence[..., None] * smooth).sum(0) / (confidence.sum(0) + GUESS_LIGHT)[:, None]
    return torch.where(confidence[..., None] > 0, mean - smooth, 0.0)
