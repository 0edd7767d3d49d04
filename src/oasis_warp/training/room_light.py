"""Fit the light of a photo, and take it off the photo."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.lighting import GAMMA, posed_normals, shading, shading_picture
from oasis_warp.avatar.observe import observe
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Evidence, HandLight

RIDGE = 0.01
"""Weight of an even light, against one of which every direction is seen."""
SHOWN = 0.1
"""Confidence from which a vertex counts as shown."""
RANGE = 0.03, 0.97
"""Quantiles of the light on what is shown, between which it is kept."""
BRIGHTEST = 0.995
"""Quantile of the colours of skin without its light that still are colours."""
DARKEST = 0.05
"""Least light, over the mean: colours are divided by it."""


def fit_light(hand: HandModel, drawn: Float[Tensor, "H W 3"], evidence: Evidence) -> HandLight:
    """The light in which `drawn` looks most like the photo.

    Weighted least squares of photo = drawn (h_0 + h . n) over the vertices that the photo shows, a colour at a time, of
    light and not of sRGB: the first two bands of the harmonics of irradiance (Ramamoorthi and Hanrahan 2001). Where
    nothing is shown light is even.

    Args:
        hand: Whose surface it is.
        drawn: What the hand looks like in even light, as the photo shows it; everywhere on it.
        evidence: The photo.
    """
    seen, known = observe(hand, evidence), observe(hand, evidence._replace(image=drawn)).colors.clamp(0, 1) ** GAMMA
    light, weight = seen.colors.clamp(0, 1) ** GAMMA, seen.confidence
    faces = hand.faces.to(weight.device)
    normals = posed_normals(evidence.rest.vertices, evidence.posed.vertices, faces)
    basis = torch.cat([torch.ones_like(normals[:, :1]), normals], 1)
    # a system a colour: [3, V, 4] and [3, V]
    terms, wanted = basis * known.T[..., None], (light - known).T
    weighted = terms * weight[:, None]
    scale = (weight[:, None] * known.square()).sum(0).clamp_min(torch.finfo(known.dtype).eps)
    ridge = RIDGE * torch.eye(4, dtype=known.dtype, device=known.device) * scale[:, None, None]
    found = torch.linalg.solve(weighted.mT @ terms + ridge, weighted.mT @ wanted[..., None])[..., 0].T
    harmonics = torch.cat([found[:1] + 1, found[1:]])
    shown = weight > SHOWN
    if not bool(shown.any()):
        harmonics = torch.zeros_like(harmonics)
        harmonics[0] = 1
        return HandLight(harmonics, torch.ones_like(harmonics[:2]), torch.ones_like(harmonics[0]))
    received = basis[shown] @ harmonics
    share = weight[shown, None]
    mean = ((received * share).sum(0) / share.sum()).clamp_min(DARKEST)
    limits = torch.stack([torch.quantile(received, level, dim=0) / mean for level in RANGE]).clamp_min(DARKEST)
    relative = HandLight(harmonics / mean, limits, torch.ones_like(mean))
    # Colours end at 1. Skin under less light than the mean would have to be brighter than that: all light is more then.
    ratio = seen.colors[shown] / shading(relative, normals[shown])
    brightest = torch.quantile(ratio.amax(1), BRIGHTEST).clamp_min(1) ** GAMMA
    return HandLight(*(part * brightest for part in relative))


def without_light(hand: HandModel, evidence: Evidence, light: HandLight) -> Evidence:
    """The same evidence with the photo as in even light; far from the hand nothing changes."""
    rest, posed = evidence.rest.vertices, evidence.posed.vertices
    factor = shading_picture(light, rest, posed, hand.faces.to(posed.device), evidence.camera)
    return evidence._replace(image=(evidence.image / factor).clamp(0, 1))
