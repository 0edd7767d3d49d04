"""Scraps: pixels beside outlines whose colours this hand's skin does not have elsewhere."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from oasis_warp.adaptation.albedo_split import ACROSS_SHADING
from oasis_warp.adaptation.sh_lighting import MIN_COLOR
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandCrop
from oasis_warp.core.windows import largest_around, smooth_mean_around
from oasis_warp.ops import DepthMap

JUMP = 0.008
"""Distance on the hand at rest between neighbouring pixels that makes an outline inside the hand, also where a finger
touches what lies behind it [m]."""
REACH, SHADOW_REACH, AROUND = 0.005, 0.01, 0.016
"""How far from an outline scraps may lie, and shadows of a part of the hand from its outline, and side of the square,
averaged over twice, that they are compared with [m]."""
DARKER, OTHER_HUE = (3.0, 4.5), (3.0, 5.0)
"""Differences from the skin around, in robust standard deviations of the rest of this hand, from which a pixel counts
less and from which it does not count. Set by eye on ten photos of tests/data/photos/same_hand, with the lengths; with
2.5 to 4 the knuckles' folds of a thumb beside its outline went, too."""
LEAST_DARK, LEAST_HUE = 0.03, 0.6
"""Least such deviations: of the mean logarithm, and of the distance from shading of `ACROSS_SHADING`."""
FEWEST = 100
"""Fewest pixels of the rest from which they are known."""


class _Outlines(NamedTuple):
    """Pixels on both sides of outlines."""

    inside: Bool[Tensor, "S S"]
    """Where another part of the hand begins."""
    around: Bool[Tensor, "S S"]
    """Where the hand ends."""


def scrap_share(hand: HandModel, drawn: Float[Tensor, "S S 3"], crop: HandCrop, seen: DepthMap) -> Float[Tensor, "S S"]:
    """How likely a pixel beside an outline shows something else than lit skin, by its colour, 0 to 1.

    Gaps and shadows between fingers, the rim of another finger and the floor are darker or of another hue than what the
    rest of this hand shows beyond `drawn`. On seen skin they were stains as soon as the hand moved. Dark creases far
    from outlines stay, and so does what has the hue of skin along the hand's own outline, and nails of any hue.

    Args:
        hand: Model of the surface.
        drawn: What the hand looks like in the light of the photo, everywhere on it.
        crop: The photo.
        seen: What its pixels show of the surface.
    """
    on, (place, nail) = seen.face_ids >= 0, _read(hand, seen)
    outlines = _outlines(on, place)
    scale = float(crop.camera.K[0, 0] / seen.depth[on].median()) if bool(on.any()) else 0.0  # pixels of a metre
    shaded, inside, around = (
        largest_around(where.to(drawn), round(reach * scale))
        for where, reach in ((outlines.inside, SHADOW_REACH), (outlines.inside, REACH), (outlines.around, REACH))
    )
    beside = torch.maximum(inside, around)
    rest = crop.mask * on * (1 - beside)
    sure = rest > 0.9
    if int(sure.sum()) < FEWEST:  # a soft mask may have none
        return torch.zeros_like(rest)
    beyond = (crop.image.clamp_min(MIN_COLOR) / drawn.clamp_min(MIN_COLOR)).log()
    # A little of what is beside outlines, where there is nothing else around.
    weight = rest + 0.05 * crop.mask * on * beside
    beyond = beyond - smooth_mean_around(beyond, weight, round(AROUND * scale) // 2)
    grey, hue = beyond.mean(-1), (beyond @ beyond.new_tensor(ACROSS_SHADING).T).norm(dim=-1)
    usual, usual_hue = (1.48 * values[sure].median() for values in (grey.abs(), hue))
    dark = _between(-grey / usual.clamp_min(LEAST_DARK), *DARKER)
    other = _between(hue / usual_hue.clamp_min(LEAST_HUE), *OTHER_HUE)
    return torch.maximum(shaded * dark, beside * (1 - nail) * other) * on


def _read(hand: HandModel, seen: DepthMap) -> tuple[Float[Tensor, "S S 3"], Float[Tensor, "S S"]]:
    """The place on the hand at rest that each pixel shows, and its share of nail; anything where it shows no hand."""
    values = torch.cat([hand.template, hand.nail[:, None].to(hand.template)], 1).to(seen.barycentrics)
    corners = hand.faces.to(seen.face_ids.device)[seen.face_ids.clamp_min(0).long()]
    read = (values[corners] * seen.barycentrics[..., None]).sum(-2)
    return read[..., :3], read[..., 3].clamp(0, 1)


def _outlines(on: Bool[Tensor, "S S"], place: Float[Tensor, "S S 3"]) -> _Outlines:
    found = _Outlines(torch.zeros_like(on), torch.zeros_like(on))
    for axis in (0, 1):
        n = on.shape[axis] - 1
        (on_a, on_b), (place_a, place_b) = ([part.narrow(axis, k, n) for k in (0, 1)] for part in (on, place))
        apart = on_a & on_b & ((place_a - place_b).norm(dim=-1) > JUMP)
        for k in (0, 1):
            found.inside.narrow(axis, k, n).logical_or_(apart)
            found.around.narrow(axis, k, n).logical_or_(on_a != on_b)
    return found


def _between(values: Tensor, low: float, high: float) -> Tensor:
    return ((values - low) / (high - low)).clamp(0, 1)
