"""How far photos can be trusted: pixels that reliably show the skin, and vertices that one photo shows best.

A fitted hand lies some pixels beside the photo's. At its outlines the photo then shows the background instead, or the
finger in front of the palm. Taken over, these pixels would be stains and ghosts in every other pose.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from oasis_warp.adaptation.scraps import scrap_share
from oasis_warp.avatar.anchors import PRIOR_SIZE
from oasis_warp.avatar.observation import Observation, inner_mask, observe, sample
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel, finger_of
from oasis_warp.core.types import HandCrop
from oasis_warp.core.windows import largest_around, smooth_mean_around
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import DepthMap, depth_map

BEHIND_REACH = 5 / PRIOR_SIZE
"""From the outline of what lies before, over the picture's side."""
BEHIND_GAP = 0.01
"""Depth by which something must lie behind an outline to be another part of the hand [m]."""
FINGER_GAP = 0.003
"""The same to the two outer phalanges of another finger [m]: a tip that lies on the palm is no more than half as thick
there. Skin that goes on from one part to the other is no finger's outline."""
STAIN_REACH = 6 / PRIOR_SIZE
"""From the mask's border, over the picture's side."""
STAIN_WINDOW = 13 / PRIOR_SIZE
"""Side of the square over which the background is averaged, twice."""
FEW, MANY = 0.15, 0.5
"""Share of background in a pixel's colour from which it counts less, and from which it does not count."""
SAME_COLOR = 0.01
"""Squared distance of colours below which skin and background cannot be told apart [sRGB^2]."""
ELSEWHERE = 0.012, 0.024
"""Distances on the hand at rest between the place that is read and the fitted one, from which a pixel counts less, and
from which it does not count [m]; neighbouring fingers are 20 mm apart."""
SURE_PLACE = 0.012, 0.02
"""Spreads of a place between which the reading begins to waver between two fingers [m]: beside another place such a
pixel does not count either."""
UNSURE_REACH, OTHER_REACH = 6 / PRIOR_SIZE, 1 / PRIOR_SIZE
"""Distances from pixels of another place, over the picture's side. Within the first an unsure reading is of that place,
too; within the second no pixel counts."""
OUTSIDE = 0.05
"""Share of hand in a pixel below which it shows the background."""


def mask_unreliable(hand: HandModel, drawn: Float[Tensor, "S S 3"], crop: HandCrop) -> HandCrop:
    """The same crop with a mask that leaves out what may be background, or another part of the hand.

    Args:
        hand: Model of the surface.
        drawn: What the hand looks like in the light of the photo, everywhere on it.
        crop: The photo.
    """
    camera = crop.camera
    vertices, faces = crop.posed.vertices, hand.faces.to(crop.posed.vertices.device)
    seen = depth_map(vertices, faces, camera.viewmat, camera.K, camera.width, camera.height, validate=False)
    behind, elsewhere = _behind_outline(hand, seen), _other_places(hand, seen, crop.reading)
    scraps = scrap_share(hand, drawn, crop, seen)
    trusted = (1 - _background_share(drawn, crop)) * ~behind * (1 - elsewhere) * (1 - scraps)
    return crop._replace(mask=crop.mask * trusted)


def _background_share(drawn: Float[Tensor, "S S 3"], crop: HandCrop) -> Float[Tensor, "S S"]:
    """How far the colour near the border lies on the way from the hand's to the background's, 0 to 1."""
    side = len(crop.mask)
    outside = (crop.mask < OUTSIDE).to(drawn)
    background = smooth_mean_around(crop.image, outside, round(STAIN_WINDOW * side / 2))
    contrast = background - drawn
    share = ((crop.image - drawn) * contrast).sum(-1) / contrast.square().sum(-1).clamp_min(SAME_COLOR)
    return ((share - FEW) / (MANY - FEW)).clamp(0, 1) * _largest(outside, STAIN_REACH)


def _behind_outline(hand: HandModel, seen: DepthMap) -> Bool[Tensor, "S S"]:
    """Whether a pixel lies just past the outline of something nearer than it."""
    on_hand, faces = seen.face_ids >= 0, hand.faces.to(seen.face_ids.device)
    segment = hand.segment.to(faces.device)[faces[seen.face_ids.clamp_min(0).long(), 0]]
    finger = torch.where(on_hand, finger_of(segment), 0)
    bent = on_hand & (segment > 0) & ((segment - 1) % 3 > 0)  # not the first phalanx, which joins the palm

    def before(where: Bool[Tensor, "S S"]) -> Float[Tensor, "S S"]:
        """How far the nearest of `where` around each pixel lies before it; -inf where there is none."""
        return seen.depth + _largest(torch.where(where, -seen.depth, -torch.inf), BEHIND_REACH)

    behind = on_hand & (before(on_hand) > BEHIND_GAP)
    for number in range(1, 6):
        behind |= on_hand & (finger != number) & (before(bent & (finger == number)) > FINGER_GAP)
    return behind


def _other_places(
    hand: HandModel, seen: DepthMap, reading: Float[Tensor, "S S 7"] | None
) -> Float[Tensor, "S S"] | float:
    """How likely a pixel shows another place than the fitted surface there, by the network's reading, 0 to 1.

    Without this, the tip of a finger whose fit lies a little beside it would be printed on the palm. 0 without a
    reading.
    """
    if reading is None:
        return 0.0
    model = hand.template if hand.origin is None else bundled_hand().template  # the network knows places on this one
    corners = model.to(reading)[hand.faces.to(reading.device)[seen.face_ids.clamp_min(0).long()]]
    distance = (reading[..., :3] - (corners * seen.barycentrics[..., None]).sum(-2)).norm(dim=-1)
    (near, far), (sure, unsure), spread = ELSEWHERE, SURE_PLACE, reading[..., 3]
    other = ((distance - near) / (far - near)).clamp(0, 1) * (spread < unsure) * (seen.face_ids >= 0)
    beside = _largest(other, UNSURE_REACH) * ((spread - sure) / (unsure - sure)).clamp(0, 1)
    return _largest(torch.maximum(other, beside), OTHER_REACH)


def _largest(values: Float[Tensor, "S S"], reach: float) -> Float[Tensor, "S S"]:
    """The largest value around each pixel, up to `reach` times the picture's side along both axes."""
    return largest_around(values, round(reach * len(values)))


SHARPNESS = 2.0
"""Power of a photo's pixels over those of the best one: with 1, detail that does not quite meet is averaged away."""
GUESS_WEIGHT = 0.25
"""Weight of the prior's guess where the light of photos is compared; a photo that sees a place well has weight 1."""
LIKELY_DIFFERENCE = 0.15
"""Usual difference between the logarithms of a colour that two photos show of one place, once their light as a whole
agrees: shading, or a pose that is a little off. Larger differences count less."""
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


def observe_photos(hand: HandModel, crops: Sequence[HandCrop], resolutions: Sequence[float]) -> VertexObservations:
    """What every photo shows, and how far to believe each: most the one that spends most pixels on the skin there.

    Args:
        hand: The model.
        crops: Crops of K photos of one hand.
        resolutions: Pixels of each photo for one pixel of its crop, along a line; below 1 the crop is an enlargement.
    """
    seen = [observe(hand, crop) for crop in crops]
    colors, confidence = (torch.stack(parts) for parts in zip(*((s.colors, s.confidence) for s in seen), strict=True))
    if len(crops) == 1:
        return VertexObservations(colors, confidence, torch.ones_like(confidence))
    density = torch.stack([
        min(1.0, scale) ** 2 * _pixel_density(crop, own)
        for crop, own, scale in zip(crops, seen, resolutions, strict=True)
    ])  # fmt: skip
    best = density.amax(0)
    share = torch.where(best > 0, (density / best.clamp_min(1e-12)) ** SHARPNESS, 1.0)
    return VertexObservations(colors, confidence, share)


def _pixel_density(crop: HandCrop, seen: Observation) -> Float[Tensor, "V"]:
    """Pixels of the crop per square metre of the skin around each vertex; 0 where hidden, turned away or cut off."""
    _, depth = project(crop.camera, crop.posed.vertices)
    inside = sample(inner_mask(crop.mask, 1)[None, None], seen.uv[None])[0, :, 0].clamp(0, 1)
    pixels = (crop.camera.K[0, 0] / depth.clamp_min(1e-3)) ** 2
    return seen.visibility * seen.facing.clamp(0, 1) * inside * pixels


def photo_gains(observations: VertexObservations, guess: Float[Tensor, "V 3"]) -> Float[Tensor, "K 3"]:
    """Brightness of each channel of each photo, relative to the first photo.

    Least squares over the differences of the logarithms of colours that two photos show of one place, with one unknown
    a photo and channel. The guess is one more photo with a small weight: it joins palm and back, which no photo shows
    together. In a place whose photos have weights w_k, the pair k, l has the weight w_k w_l / sum w; the same follows
    from eliminating the place's own colour. Shadows and misplaced detail are weighted down (Cauchy).

    Args:
        observations: Observations of K photos.
        guess: Colours of the vertices as the prior has them, in any light.
    """
    n_photos = len(observations.colors)
    logs = torch.cat([observations.colors, guess[None]]).clamp(DARKEST, 1).log()
    clear = (observations.colors > DARKEST) & (observations.colors < BRIGHTEST)
    trust = (observations.confidence * observations.share)[..., None] * clear
    trust = torch.cat([trust, GUESS_WEIGHT * (trust.amax(0, keepdim=True) > 0)]).to(logs)
    gains = logs.new_zeros(n_photos + 1, 3)
    ridge = 1e-6 * torch.eye(n_photos, dtype=logs.dtype, device=logs.device)  # a photo that shows nothing keeps 1
    weight = trust
    for _ in range(GAIN_ROUNDS):
        total = weight.sum(0).clamp_min(1e-12)
        pairs = torch.einsum("kvc,lvc->ckl", weight / total, weight)
        system = torch.diag_embed(pairs.sum(-1)) - pairs
        right = (weight * (logs - (weight * logs).sum(0) / total)).sum(1).T
        gains[:n_photos] = torch.linalg.solve(system[:, :-1, :-1] + ridge, right[:, :-1]).T
        even = logs - gains[:, None]
        apart = even - (weight * even).sum(0) / total
        weight = trust / (1 + (apart / LIKELY_DIFFERENCE) ** 2)
    return (gains[:n_photos] - gains[:1]).exp()
