"""One avatar of several photos: their guesses mixed, their light made one, and one adaptation to all of them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.mixture import mix_guesses
from oasis_warp.avatar.observe import Observation, inner_mask, observe
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import CanonicalGaussians, Evidence
from oasis_warp.ops import blend_colors, stack_weights
from oasis_warp.render.cameras import orbit_camera
from oasis_warp.training.adapt import MIN_ALPHA, adapt
from oasis_warp.training.calibrate import calibrate
from oasis_warp.training.complete import complete_field
from oasis_warp.training.light import even_photo
from oasis_warp.training.sightings import Sightings, look, photo_gains
from oasis_warp.training.texture import learn_texture
from oasis_warp.training.views import freeze_view, reference_azimuths

SHADING_LENGTH = 0.01
"""What changes over a longer way along the skin may be light, and photos meet halfway in it [m]."""
REACH = 0.1
"""Way over which a photo's shading would be forgotten where the photo says nothing [m]: not within a hand."""
GUESS_LIGHT = 4.0
"""Weight of the prior's guess in the shading, against a photo that sees the place well. On synthetic people in any
light more is better, up to here at least: 4 photos come to 20.8 dB without it, 22.3 with 1, 23.3 with 4."""
UNSEEN = 0.02
"""Weight of a photo's guess where the photo shows nothing, against one that sees the place well."""


class Fusion(NamedTuple):
    """The Gaussians of all photos, in the light of the first, and how they came about."""

    gaussians: CanonicalGaussians
    guess: CanonicalGaussians
    """Before adaptation: the prior's guesses of all photos, mixed."""
    sightings: Sightings
    gains: Float[Tensor, "K 3"]
    """How much brighter each photo is than the first."""


def fuse(
    hand: HandModel,
    evidences: Sequence[Evidence],
    resolution: Sequence[float],
    guesses: Sequence[CanonicalGaussians],
    config: AdaptConfig = AdaptConfig(),  # noqa: B008 - frozen
    progress: Progress = silent,
) -> Fusion:
    """Make one hand of K photos; of one, what `training.adapt.adapt` makes of it.

    Args:
        hand: The model.
        evidences: All with one surface at rest, on one device, of one size.
        resolution: See `sightings.look`.
        guesses: What the prior makes of every photo.
        config: Of the adaptation.
        progress: Told of the adaptation's steps.
    """
    sightings = look(hand, evidences, resolution)
    if len(guesses) == 1:
        made = adapt(hand, guesses[0], evidences[0], config, progress)
        return Fusion(made.gaussians, guesses[0], sightings, torch.ones_like(sightings.colors[:, 0]))
    faces = hand.faces.to(evidences[0].image.device)
    guess = mix_guesses(guesses, sightings.confidence * sightings.share + UNSEEN, faces)
    gains = photo_gains(sightings, vertex_colors(guess, len(hand.template)))
    made = _adapt(hand, guess, evidences, sightings, gains, config, progress)
    return Fusion(made, guess, sightings, gains)


def _adapt(
    hand: HandModel, guess: CanonicalGaussians, evidences: Sequence[Evidence], sightings: Sightings, gains: Tensor,
    config: AdaptConfig, progress: Progress,
) -> CanonicalGaussians:  # fmt: skip
    """The steps of `training.adapt.adapt`, on all photos at once: their pictures stand below each other as one.

    A pixel counts as much as its photo is to be believed there.
    """
    first = evidences[0]
    faces, rest = hand.faces.to(first.image.device), first.rest.vertices
    posed = [pose_gaussians(guess, faces, e.rest.vertices, e.posed.vertices) for e in evidences]
    views = [freeze_view(there, evidence.camera) for there, evidence in zip(posed, evidences, strict=True)]
    lit = [evidence.image / gain for evidence, gain in zip(evidences, gains, strict=True)]
    trusted = []
    for evidence, view, share in zip(evidences, views, sightings.share, strict=True):
        drawn = blend_colors(view, vertex_to_gaussians(share[:, None], faces, guess))
        solid = view.alphas > 0.5
        believed = (drawn / view.alphas.clamp_min(MIN_ALPHA) * solid)[..., 0]
        trusted.append(inner_mask(evidence.mask, 1) * believed)
    tall, trust = stack_weights(views), torch.cat(trusted)

    progress("calibration", 0, 1)
    if config.calibration == "on":
        guess = guess._replace(colors=calibrate(tall, guess.colors, torch.cat(lit), trust, config).apply(guess.colors))
    progress("calibration", 1, 1)

    progress("completion", 0, 1)
    weight = sightings.confidence * sightings.share
    drawn = [blend_colors(view, guess.colors) / view.alphas.clamp_min(MIN_ALPHA) for view in views]

    def differences() -> Tensor:
        return torch.stack([
            observe(hand, evidence._replace(image=photo - picture)).colors
            for evidence, photo, picture in zip(evidences, lit, drawn, strict=True)
        ])  # fmt: skip

    shading = _other_shading(hand, rest, differences(), sightings.confidence)
    lit = [
        photo + blend_colors(view, vertex_to_gaussians(other, faces, guess)) / view.alphas.clamp_min(MIN_ALPHA)
        for photo, view, other in zip(lit, views, shading, strict=True)
    ]
    if config.light == "even":
        lit = [
            even_photo(photo, picture, Observation(own, seen), view, guess, rest, faces)
            for photo, picture, own, seen, view in zip(
                lit, drawn, differences(), sightings.confidence, views, strict=True
            )
        ]
    missing = (weight[..., None] * differences()).sum(0) / weight.sum(0).clamp_min(1e-12)[:, None]
    difference = complete_field(rest, faces, missing, weight.amax(0))
    colors = (guess.colors + vertex_to_gaussians(difference, faces, guess)).clamp(0, 1)
    progress("completion", 1, 1)

    references = [
        freeze_view(posed[0], orbit_camera(first.posed.vertices, azimuth, size=first.camera.width))
        for azimuth in reference_azimuths(config.reference_views)
    ]
    mask = torch.cat([evidence.mask for evidence in evidences]) * trust
    guess = guess._replace(colors=colors)
    return guess._replace(
        colors=learn_texture(guess, faces, tall, torch.cat(lit), mask, references, config, progress).colors
    )


def _other_shading(
    hand: HandModel, rest: Float[Tensor, "V 3"], differences: Float[Tensor, "K V 3"], confidence: Float[Tensor, "K V"]
) -> Float[Tensor, "K V 3"]:
    """What to add to each photo, smoothly over the skin, so that photos agree wherever two show the same place.

    Lamps stand elsewhere in every photo, and fingers shade each other. No photo is right about it: they meet at the
    mean of what each differs from the guess, the guess itself among them. Detail stays with the photo that shows it
    best.
    """
    smooth = torch.stack([
        complete_field(rest, hand.faces, own, seen, detail=SHADING_LENGTH, fade=REACH)
        for own, seen in zip(differences, confidence, strict=True)
    ])  # fmt: skip
    mean = (confidence[..., None] * smooth).sum(0) / (confidence.sum(0) + GUESS_LIGHT)[:, None]
    return torch.where(confidence[..., None] > 0, mean - smooth, 0.0)
