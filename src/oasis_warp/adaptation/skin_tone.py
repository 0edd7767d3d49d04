"""The tone of a person's skin: its melanin, and the mean colours of all regions as the photo shows them."""

import functools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.avatar.appearance import BLOOD_MEAN, Regions, nail_color, skin_color, skin_melanin, skin_regions
from oasis_warp.avatar.prior import DARKEST, LIGHTEST, SIGMA_CAST, SIGMA_EXPOSURE, TONES
from oasis_warp.core.hand_model import HandModel
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
MOST_APART = 1.0
"""Most that the logarithm of the melanin differs from what a network reads in the photo. On 54 synthetic photos the two
differ by up to .7; on two of 52 photos of light hands in same_hand the guess took dim light for dark skin, by 2 to 2.5.
A bound, because where they agree the guess is better: .42 off the truth on those synthetic photos, the reading .60."""
MIN_COLOURFUL = 0.4
"""Least saturation of a photo over that of skin in even light: less is taken for a cast of grey light."""
MIN_COLOR = 0.01
"""Least colour whose logarithm is taken."""


class SkinTone(NamedTuple):
    """Mean colours of a person in the light of the photo."""

    log_skin: Float[Tensor, "V 3"]
    """Logarithms of the sRGB colours of skin at the vertices; under nails too."""
    log_nail: Float[Tensor, "3"]
    """Log colour of a nail's bed, seen through its plate."""
    melanin: float
    """Share on the back."""


def infer_tone(
    hand: HandModel,
    guess: Float[Tensor, "V 3"],
    seen: Float[Tensor, "V 3"],
    weight: Float[Tensor, "V"],
    reading: Float[Tensor, "S S 7"] | None = None,
) -> SkinTone:
    """Mean colours of all regions, for the tone of the guess, as the photo shows them.

    For every tone the gain of each channel is the mean of the logarithms' differences to the guess. The remaining
    brightness and cast of the gain are weighed by their expected sizes; the tone is the posterior mean of log melanin.
    The guess of a learned prior knows the tone better than the photo's own colours: light skin in dim light and dark
    skin in bright light look alike. In a photo that is less colourful than skin, all differences of regions are less
    colourful, too.

    Args:
        hand: The model.
        guess: sRGB colours of the prior at the vertices, before they were calibrated.
        seen: Those fitted to the photo, in even light.
        weight: How far to trust these.
        reading: `HandCrop.reading`; without it the guess alone tells the tone.
    """
    table, nails = (part.to(seen) for part in _tone_table())
    bare = 1 - skin_regions(hand).nail.to(seen)
    tones = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES).to(seen)
    log_melanin = _log_melanin(table, tones, guess.clamp_min(MIN_COLOR).log(), bare / bare.sum())
    read = None if reading is None else _melanin_read(table, tones, reading, bare)
    if read is not None:
        log_melanin = log_melanin.clamp(read - MOST_APART, read + MOST_APART)
    place = ((log_melanin - tones[0]) / (tones[1] - tones[0])).clamp(0, TONES - 1)
    low = place.long().clamp_max(TONES - 2)
    skin, nail = (torch.lerp(part[low], part[low + 1], place - low) for part in (table, nails))
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
    tones = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES).exp().tolist()
    pairs = [tone_colors(regions, tone) for tone in tones]
    return torch.stack([skin for skin, _ in pairs]).log(), torch.stack([nail for _, nail in pairs]).log()


def tone_colors(regions: Regions, melanin: float) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "3"]]:
    """Evenly lit sRGB colours of smooth skin and of nails of a hand whose back has this `melanin` share."""
    palm, tip, knuckle = regions.palm, regions.finger_tip, regions.knuckle
    amount = skin_melanin(palm, melanin) * (1 + KNUCKLE_MELANIN * knuckle)
    blood = BLOOD_MEAN * (1 + PALM_BLOOD * palm + TIP_BLOOD * tip * (0.4 + 0.6 * palm) + KNUCKLE_BLOOD * knuckle)
    return skin_color(amount, blood), nail_color(amount.new_tensor([melanin]))[0]
