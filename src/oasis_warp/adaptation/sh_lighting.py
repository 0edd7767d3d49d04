"""Fit the light of a photo, and take it off the photo."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.avatar.lighting import GAMMA, posed_normals, shading, shading_picture
from oasis_warp.avatar.observation import observe
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandCrop, HandLight

USUAL = (1.0, 0.0, -0.12, -0.15)
"""Harmonics that light has in the mean where a photo's tone is even: more from above, and from the camera's side."""
SPREAD = (
    (0.057, 0.0, -0.010, 0.018),
    (0.0, 0.020, 0.0, 0.0),
    (-0.010, 0.0, 0.033, -0.006),
    (0.018, 0.0, -0.006, 0.064),
)
"""Their covariance. Both are those of synthetic rooms (studies/measure_light.py), made alike left and right."""
RIDGE = 0.001
"""Weight of what is usual, against a light of which every direction is seen."""
SHOWN = 0.1
"""Confidence from which a vertex counts as shown."""
RANGE = 0.03, 0.97
"""Quantiles of the light on what is shown, between which it is kept."""
BRIGHTEST = 0.995
"""Quantile of the colours of skin without its light that still are colours."""
STRANGE, STRANGE_FADE = 1.5, 0.001
"""Largest logarithm of shade where the photo may show something else, and the way over which that ends [m]."""
DARK = 0.02
"""Colours below it have no logarithm worth the name [sRGB]."""
DARKEST = 0.05
"""Least light, over the mean: colours are divided by it."""


def fit_light(hand: HandModel, drawn: Float[Tensor, "H W 3"], crop: HandCrop) -> HandLight:
    """The light in which `drawn` looks most like the photo.

    Weighted least squares of photo = drawn (h_0 + h . n) over the vertices that the photo shows, a colour at a time, of
    light and not of sRGB: the first two bands of the harmonics of irradiance (Ramamoorthi and Hanrahan 2001). A photo
    shows the skin that faces it; what falls on the rest is drawn to what is usual (the maximum a posteriori of a normal
    distribution). Where nothing is shown light is even.

    Args:
        hand: Whose surface it is.
        drawn: What the hand looks like in even light, as the photo shows it; everywhere on it.
        crop: The photo.
    """
    seen, known = observe(hand, crop), observe(hand, crop._replace(image=drawn)).colors.clamp(0, 1) ** GAMMA
    light, weight = seen.colors.clamp(0, 1) ** GAMMA, seen.confidence
    faces = hand.faces.to(weight.device)
    normals = posed_normals(crop.rest.vertices, crop.posed.vertices, faces)
    basis = torch.cat([torch.ones_like(normals[:, :1]), normals], 1)
    # a system a colour: [3, V, 4]
    terms = basis * known.T[..., None]
    weighted = terms * weight[:, None]
    scale = (weight[:, None] * known.square()).sum(0).clamp_min(torch.finfo(known.dtype).eps)
    ridge = RIDGE * torch.linalg.inv(known.new_tensor(SPREAD)) * scale[:, None, None]
    right = weighted.mT @ light.T[..., None] + ridge @ known.new_tensor(USUAL)[:, None]
    harmonics = torch.linalg.solve(weighted.mT @ terms + ridge, right)[..., 0].T
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
    return HandLight(relative.harmonics * brightest, relative.limits * brightest, relative.even * brightest)


def with_shade(
    hand: HandModel, drawn: Float[Tensor, "H W 3"], crop: HandCrop, sure: HandCrop, light: HandLight
) -> HandLight:
    """`light` with what it misses where the photo may show something else than the skin there.

    Args:
        hand: Whose surface it is.
        drawn: What the hand looks like in even light, as the photo shows it; everywhere on it.
        crop: The photo.
        sure: The same with the mask of `mask_unreliable`.
        light: Of the photo.
    """
    faces, rest = hand.faces.to(drawn.device), crop.rest.vertices
    lit = apply_light(hand, drawn, crop, light)
    seen, known = observe(hand, crop), observe(hand, crop._replace(image=lit)).colors
    missing = (seen.colors.clamp_min(DARK) / known.clamp_min(DARK)).log()
    believed = observe(hand, sure).confidence
    strange = inpaint(rest, faces, missing, seen.confidence - believed, STRANGE_FADE / 3, STRANGE_FADE)
    facing = posed_normals(rest, crop.posed.vertices, faces)
    return light._replace(shade=strange.clamp(-STRANGE, STRANGE).exp(), facing=facing)


def without_light(hand: HandModel, crop: HandCrop, light: HandLight) -> HandCrop:
    """The same crop with the photo as in even light; far from the hand nothing changes."""
    return crop._replace(image=(crop.image / _factor(hand, crop, light)).clamp(0, 1))


def apply_light(
    hand: HandModel, drawn: Float[Tensor, "H W 3"], crop: HandCrop, light: HandLight
) -> Float[Tensor, "H W 3"]:
    """`drawn`, a picture in even light of what `crop` shows, as `light` shows it."""
    return (drawn * _factor(hand, crop, light)).clamp(0, 1)


def _factor(hand: HandModel, crop: HandCrop, light: HandLight) -> Float[Tensor, "H W 3"]:
    rest, posed = crop.rest.vertices, crop.posed.vertices
    return shading_picture(light, rest, posed, hand.faces.to(posed.device), crop.camera)
