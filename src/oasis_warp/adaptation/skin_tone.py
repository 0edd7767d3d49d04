"""The tone of a person's skin: its melanin, and the mean colours of all regions as the photo shows them."""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import BLOOD_MEAN, Regions, nail_color, skin_color, skin_melanin, skin_regions
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.prior import DARKEST, LIGHTEST, SIGMA_CAST, SIGMA_EXPOSURE, TONES
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop
from oasis_warp.hand.template import bundled_hand

SIGMA_COLOR = 0.05
"""Expected difference of a person's skin from the mean of that region and tone, as a logarithm."""
PALM_BLOOD, TIP_BLOOD, KNUCKLE_BLOOD = 1.1, 0.7, 1.1
"""How much more blood palms, finger tips and knuckles have than backs. With it palm minus back in CIELAB's a* is +2 to
+6, as on real hands."""
KNUCKLE_MELANIN = 0.15
"""How much more melanin knuckles have."""
SURE_PLACE, FEWEST = 0.006, 200
"""Spread of a place up to which a network's albedo there counts [m], and fewest such pixels."""
SIGMA_TONE, FREEDOM = 0.2, 3
"""Scale and degrees of freedom of Student's t distribution of the error of each network's logarithm of melanin. That
is .5 in the root mean square on 54 synthetic photos, but up to 2.5 on photos of light hands in dim light. With heavier
tails (.4 and 1) the mean leaned to the middle of all tones, which cost .5 dB on synthetic people in even light."""
SIGMA_BRIGHTER, BRIGHTER_NOISE = 0.12, 0.0005
"""Standard deviation of how much brighter palms are than backs in a photo, as a logarithm: .08 on those synthetic
photos, .15 on 24 of light hands in same_hand. And the variance of shading that adds to its square, over the variance of
palm that shading does not explain."""
SHADING_RIDGE = 0.03
"""Weight of the gradient of shading along the normal, against the mean square of the logarithms' error."""
MIN_COLOURFUL = 0.4
"""Least saturation of a photo over that of skin in even light: less is taken for a cast of grey light."""
MIN_COLOR = 0.01
"""Least colour whose logarithm is taken."""
TINY = 1e-6
"""Keeps a matrix invertible where a photo shows one side only."""


class SkinTone(NamedTuple):
    """Mean colours of a person in the light of the photo."""

    log_skin: Float[Tensor, "V 3"]
    """Logarithms of the sRGB colours of skin at the vertices; under nails too."""
    log_nail: Float[Tensor, "3"]
    """Log colour of a nail's bed, seen through its plate."""
    melanin: float
    """Share on the back."""


@torch.no_grad()
def with_likely_tone(
    hand: HandModel, guesses: Sequence[CanonicalGaussians], crops: Sequence[HandCrop]
) -> list[CanonicalGaussians]:
    """Guesses of one hand, one for each photo, in the tone that all evidence together makes likely.

    A network cannot tell dark skin from dim light, but the light of a photo does not follow the border of the palm. For
    each tone, the cost adds up how far it is from the tone of every guess, from that of the albedo that the dense
    network reads (`HandCrop.reading`), and how much brighter the palm would be than the back, compared with the photo.
    The tone is the posterior mean of log melanin; a guess changes by the ratio of both tones' colours.

    Args:
        hand: The model.
        guesses: Of the prior.
        crops: The photos.
    """
    like, faces = guesses[0].colors, hand.faces.to(guesses[0].colors.device)
    (table, nails), tones = (part.to(like) for part in _tone_table()), _log_tones(like)
    nail = skin_regions(hand).nail.to(like)
    bare, cost, own = 1 - nail, torch.zeros_like(tones), []
    brighter = _brighter_palms(table, bare)
    for guess, crop in zip(guesses, crops, strict=True):
        colors = vertex_colors(guess, len(hand.template)).clamp_min(MIN_COLOR).log()
        own.append(_log_melanin(table, tones, colors, bare / bare.sum()))
        read = None if crop.reading is None else _melanin_read(table, tones, crop.reading, bare)
        for told in (own[-1], read):
            if told is not None:
                apart = ((tones - told) / SIGMA_TONE).square()
                cost = cost + (FREEDOM + 1) * torch.log1p(apart / FREEDOM)
        shown, variance = _palm_over_back(hand, crop)
        cost = cost + (shown - brighter).square() / variance
    likely = torch.softmax(-cost / 2, 0) @ tones

    def in_tone(guess: CanonicalGaussians, of_guess: Tensor) -> CanonicalGaussians:
        skin, plate = (_at_tone(part, likely) - _at_tone(part, of_guess) for part in (table, nails))
        change = vertex_to_gaussians(skin + nail[:, None] * (plate - skin), faces, guess)
        return guess._replace(colors=(guess.colors * change.exp()).clamp(0, 1))

    return [in_tone(guess, of_guess) for guess, of_guess in zip(guesses, own, strict=True)]


def _palm_over_back(hand: HandModel, crop: HandCrop) -> tuple[Tensor, Tensor]:
    """Logarithm of the palm's brightness over the back's in a photo, and its variance.

    The photo's logarithms are fitted by a shading that is linear in the normal, and this step.
    """
    seen, regions = observe(hand, crop), skin_regions(hand)
    palm, weight = regions.palm.to(seen.colors), seen.confidence * (1 - regions.nail.to(seen.colors))
    normals = surface.vertex_normals(crop.posed.vertices, hand.faces.to(palm.device))
    design = torch.cat([torch.ones_like(palm)[:, None], normals, palm[:, None]], 1).double()
    weight = (weight / weight.sum().clamp_min(1e-9))[:, None].double()
    ridge = design.new_tensor([0, *(SHADING_RIDGE,) * 3, 0]) + TINY
    inverse = torch.linalg.inv((weight * design).T @ design + torch.diag(ridge))
    logs = seen.colors.clamp_min(MIN_COLOR).log().mean(1, keepdim=True).double()
    step = (inverse @ ((weight * design).T @ logs))[-1, 0]
    return step.to(palm), (SIGMA_BRIGHTER**2 + BRIGHTER_NOISE * inverse[-1, -1]).to(palm)


def _brighter_palms(table: Float[Tensor, "T V 3"], bare: Float[Tensor, "V"]) -> Float[Tensor, "T"]:
    """Logarithms of the palm's brightness over the back's, for every tone."""
    palm = skin_regions(bundled_hand()).palm.to(bare)
    of_palm, of_back = (table.mean(2) @ share / share.sum() for share in (palm * bare, (1 - palm) * bare))
    return of_palm - of_back


def infer_tone(
    hand: HandModel,
    guess: Float[Tensor, "V 3"],
    seen: Float[Tensor, "V 3"],
    weight: Float[Tensor, "V"],
) -> SkinTone:
    """Mean colours of all regions, for the tone of the guess, as the photo shows them.

    For every tone the gain of each channel is the mean of the logarithms' differences to the guess. The remaining
    brightness and cast of the gain are weighed by their expected sizes; the tone is the posterior mean of log melanin.
    In a photo that is less colourful than skin, all differences of regions are less colourful, too.

    Args:
        hand: The model.
        guess: sRGB colours of `with_likely_tone` at the vertices, before they were calibrated.
        seen: Those fitted to the photo, in even light.
        weight: How far to trust these.
    """
    table, nails = (part.to(seen) for part in _tone_table())
    bare = 1 - skin_regions(hand).nail.to(seen)
    log_melanin = _log_melanin(table, _log_tones(seen), guess.clamp_min(MIN_COLOR).log(), bare / bare.sum())
    skin, nail = (_at_tone(part, log_melanin) for part in (table, nails))
    share = weight * bare / (weight * bare).sum().clamp_min(1e-9)
    shown, mean = ((share[:, None] * logs).sum(0) for logs in (seen.clamp_min(MIN_COLOR).log(), skin))
    colour = mean - mean.mean()
    colourful = ((shown - shown.mean()) @ colour / colour.square().sum()).clamp(MIN_COLOURFUL, 1)

    def in_photo_colors(logs: Tensor) -> Tensor:
        """Its difference from the mean, less colourful, on what the photo shows."""
        beyond = logs - mean
        grey = beyond.mean(-1, keepdim=True)
        return shown + grey + colourful * (beyond - grey)

    return SkinTone(in_photo_colors(skin), in_photo_colors(nail), float(log_melanin.exp()))


def _log_tones(like: Tensor) -> Float[Tensor, "T"]:
    return torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES).to(like)


def _at_tone(table: Float[Tensor, "T *V 3"], log_melanin: Tensor) -> Float[Tensor, "*V 3"]:
    """Logarithms of colours between the tones of `table`."""
    tones = _log_tones(log_melanin)
    place = ((log_melanin - tones[0]) / (tones[1] - tones[0])).clamp(0, TONES - 1)
    low = place.long().clamp_max(TONES - 2)
    return torch.lerp(table[low], table[low + 1], place - low)


def _melanin_read(
    table: Float[Tensor, "T V 3"], tones: Float[Tensor, "T"], reading: Float[Tensor, "S S 7"], bare: Float[Tensor, "V"]
) -> Tensor | None:
    """Logarithm of the melanin that the albedo of a reading tells; None where it shows hardly any skin."""
    places, albedo = reading[reading[..., 3] < SURE_PLACE].split([4, 3], 1)
    nearest = cKDTree(bundled_hand().template.double().numpy()).query(places[:, :3].double().cpu().numpy())[1]
    at = torch.from_numpy(nearest).to(bare.device)
    weight = bare[at]
    if float(weight.sum()) < FEWEST:
        return None
    return _log_melanin(table[:, at], tones, albedo.to(table).clamp_min(MIN_COLOR).log(), weight / weight.sum())


def _log_melanin(
    table: Float[Tensor, "T V 3"], tones: Float[Tensor, "T"], logs: Float[Tensor, "V 3"], share: Float[Tensor, "V"]
) -> Tensor:
    """Posterior mean over the tones that explain the logarithms of colours."""
    difference = logs - table
    gain = (share[:, None] * difference).sum(1)
    left = (share[:, None] * (difference - gain[:, None]).square()).sum(1).mean(1)
    cast = gain[:, 0::2] - gain[:, 1:2]
    cost = left / SIGMA_COLOR**2 + (gain.mean(1) / SIGMA_EXPOSURE).square() + (cast / SIGMA_CAST).square().sum(1)
    return torch.softmax(-cost / 2, 0) @ tones


@functools.cache
def _tone_table() -> tuple[Float[Tensor, "T V 3"], Float[Tensor, "T 3"]]:
    """Logarithms of skin colours at the vertices and of a nail, for every tone."""
    regions = skin_regions(bundled_hand())
    tones = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES).exp()
    pairs = [tone_colors(regions, tone) for tone in tones.tolist()]
    return torch.stack([skin for skin, _ in pairs]).log(), torch.stack([nail for _, nail in pairs]).log()


def tone_colors(regions: Regions, melanin: float) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "3"]]:
    """Evenly lit sRGB colours of smooth skin and of nails of a hand whose back has this `melanin` share."""
    palm, tip, knuckle = regions.palm, regions.finger_tip, regions.knuckle
    amount = skin_melanin(palm, melanin) * (1 + KNUCKLE_MELANIN * knuckle)
    blood = BLOOD_MEAN * (1 + PALM_BLOOD * palm + TIP_BLOOD * tip * (0.4 + 0.6 * palm) + KNUCKLE_BLOOD * knuckle)
    return skin_color(amount, blood), nail_color(amount.new_tensor([melanin]))[0]
