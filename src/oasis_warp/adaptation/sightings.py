"""What several photos show of one hand: where to believe which, and how their light differs."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.observation import VISIBILITY_MARGIN, facing, inner_mask, observe
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandCrop
from oasis_warp.ops import depth_visibility

SHARPNESS = 2.0
"""Power of a photo's pixels over those of the best one: with 1, detail that does not quite meet is averaged away."""
GUESS_WEIGHT = 0.25
"""Of the prior's guess against a photo that sees a place well, where the light of photos is compared."""
LIKELY_DIFFERENCE = 0.15
"""Of the logarithms of a colour that two photos show of one place, once their light as a whole agrees: shading, a pose
that is a little off. Larger ones count less."""
GAIN_ROUNDS = 12
DARKEST, BRIGHTEST = 0.02, 0.98
"""Values beyond which a sensor is blind, or clips."""


class VertexObservations(NamedTuple):
    """What K photos show of the V vertices of one hand."""

    colors: Float[Tensor, "K V 3"]
    confidence: Float[Tensor, "K V"]
    """As `Observation.confidence`."""
    share: Float[Tensor, "K V"]
    """How much a photo counts beside the one that shows a place best: 1 for that one, and where none shows it."""


def look(hand: HandModel, crops: Sequence[HandCrop], resolution: Sequence[float]) -> VertexObservations:
    """What every photo shows, and which to believe: the one that spends most pixels on the skin there.

    Args:
        hand: The model.
        crops: Of K photos of one hand.
        resolution: Pixels of each photo a pixel of its crop, along a line; below 1 the crop is an enlargement.
    """
    seen = [observe(hand, crop) for crop in crops]
    density = torch.stack([
        min(1.0, scale) ** 2 * _pixel_density(hand, crop)
        for crop, scale in zip(crops, resolution, strict=True)
    ])  # fmt: skip
    best = density.amax(0)
    share = torch.where(best > 0, (density / best.clamp_min(1e-12)) ** SHARPNESS, 1.0)
    return VertexObservations(
        torch.stack([photo.colors for photo in seen]), torch.stack([photo.confidence for photo in seen]), share
    )


def _pixel_density(hand: HandModel, crop: HandCrop) -> Float[Tensor, "V"]:
    """Pixels of the crop a square metre of the skin round each vertex; 0 where it is hidden, turned away or cut off."""
    vertices, camera = crop.posed.vertices, crop.camera
    faces = hand.faces.to(vertices.device)
    visible, _, _ = depth_visibility(
        vertices, vertices, faces, camera.K, camera.viewmat, camera.width, camera.height, margin=VISIBILITY_MARGIN,
        point_vertices=torch.arange(len(vertices), device=vertices.device),
    )  # fmt: skip
    turned = facing(vertices, faces, camera).clamp(0, 1)
    _, depth = project(camera, vertices)
    inside = observe(hand, crop._replace(image=inner_mask(crop.mask, 1)[..., None].expand(-1, -1, 3)))
    return visible * turned * inside.colors[:, 0].clamp(0, 1) * (camera.K[0, 0] / depth.clamp_min(1e-3)) ** 2


def photo_gains(sightings: VertexObservations, guess: Float[Tensor, "V 3"]) -> Float[Tensor, "K 3"]:
    """How much brighter each photo shows each channel than the first one does.

    The least squares of all differences of the logarithms of colours that two photos show of one place, with one
    unknown a photo and channel. The guess is one more photo, with a small weight: it joins palm and back, which no
    photo shows together. In a place whose photos weigh w_k, the pair k, l weighs w_k w_l / sum w, as it does when the
    place's own colour is eliminated. Reweighted against shadows and misplaced detail (Cauchy).

    Args:
        sightings: Of K photos.
        guess: Colours of the vertices as the prior has them, in any light.
    """
    n_photos = len(sightings.colors)
    logs = torch.cat([sightings.colors, guess[None]]).clamp(DARKEST, 1).log()
    clear = (sightings.colors > DARKEST) & (sightings.colors < BRIGHTEST)
    trust = (sightings.confidence * sightings.share)[..., None] * clear
    trust = torch.cat([trust, GUESS_WEIGHT * (trust.amax(0, keepdim=True) > 0)]).to(logs)
    gains = logs.new_zeros(n_photos + 1, 3)
    still = 1e-6 * torch.eye(n_photos, dtype=logs.dtype, device=logs.device)  # a photo that shows nothing keeps 1
    weight = trust
    for _ in range(GAIN_ROUNDS):
        total = weight.sum(0).clamp_min(1e-12)
        pairs = torch.einsum("kvc,lvc->ckl", weight / total, weight)
        system = torch.diag_embed(pairs.sum(-1)) - pairs
        right = (weight * (logs - (weight * logs).sum(0) / total)).sum(1).T
        gains[:n_photos] = torch.linalg.solve(system[:, :-1, :-1] + still, right[:, :-1]).T
        even = logs - gains[:, None]
        apart = even - (weight * even).sum(0) / total
        weight = trust / (1 + (apart / LIKELY_DIFFERENCE) ** 2)
    return (gains[:n_photos] - gains[:1]).exp()
