"""Shade at the rim of what photos show: kept to what light does to skin, and just behind the rim as at the rim."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.adaptation.sh_lighting import MIN_CONFIDENCE
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.pose import MIN_COLOR
from oasis_warp.avatar.vertex_light import posed_lighting, shading
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight

LIKELY_SHADE, LIKELY_HUE = (-0.6, 0.25), 0.1
"""Range of the logarithm of shade on a slant, and of each channel's difference from the mean of all, which light gives
to skin; set by eye, as the two below, on four of the photos in docs/looks.md."""
SLANTED, OPENLY = 0.15, 0.4
"""Cosines between normal and view up to which and from which skin is seen on a slant and openly."""


def limit_shade(
    hand: HandModel, gaussians: CanonicalGaussians, crops: Sequence[HandCrop], light: HandLight
) -> CanonicalGaussians:
    """Limit the shade to what light gives to skin, where all photos show that skin on a slant.

    A pixel there also shows what lies beside the outline, such as the floor between fingers. In the photo's view this
    is a rim of one pixel, but from the side it is a streak along a finger.

    Args:
        hand: Model of the surface.
        gaussians: Adapted to the photos.
        crops: The photos.
        light: Light of the first.
    """
    if gaussians.shade is None:
        return gaussians
    facing = torch.stack([observe(hand, crop).facing for crop in crops]).amax(0)
    slant = ((OPENLY - facing) / (OPENLY - SLANTED)).clamp(0, 1)
    vertex_shade = torch.ones_like(crops[0].rest.vertices) if light.shade is None else light.shade
    on_vertices = torch.cat([vertex_shade, slant[:, None]], 1)
    own, share = vertex_to_gaussians(on_vertices, hand.faces.to(slant.device), gaussians).split([3, 1], 1)
    total = (own * gaussians.shade).log()
    limited = torch.lerp(total, _likely(total, *LIKELY_SHADE), share).exp() / own
    return gaussians._replace(shade=torch.where(share > 0, limited, gaussians.shade))


def _likely(log_shade: Float[Tensor, "N 3"], least: float, most: float) -> Float[Tensor, "N 3"]:
    """The nearest shade that light can give to skin."""
    grey = log_shade.mean(-1, keepdim=True)
    return grey.clamp(least, most) + (log_shade - grey).clamp(-LIKELY_HUE, LIKELY_HUE)


MAX_BEHIND = 0.5
"""Largest logarithm of shade behind the rim."""
EDGE_DETAIL, JUST_BEHIND = 0.0005, 0.003
"""Length below which the rim's colours are averaged, and distance over which skin behind it gets as different from it
as its own colour and light make it [m]: Gaussians of 1 mm show that far past what hides them."""
MIN_PROXIMITY = 1e-3
"""Share of the rim in a mean over the skin around, below which that mean tells nothing."""


def match_rim(hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, light: HandLight) -> HandLight:
    """Draw skin just behind the rim in the colours of the rim.

    Gaussians there show past every outline, those inside the hand too. In their own colour and light they were thin
    lines along fingers in front of fingers.

    Args:
        hand: Model of the surface.
        gaussians: Adapted to the photos.
        crop: The first photo.
        light: Its light.
    """
    if gaussians.shade is None or light.shade is None:
        return light
    rest, faces, seen = crop.rest.vertices, hand.faces.to(crop.image.device), observe(hand, crop)
    lit = shading(light, posed_lighting(rest, crop.posed.vertices, faces, light))
    unshaded, own = (
        vertex_colors(gaussians._replace(colors=colors.clamp_min(MIN_COLOR).log()), len(rest))
        for colors in (gaussians.colors, gaussians.shade)
    )
    unshaded = unshaded + lit.clamp_min(MIN_COLOR).log()
    known = seen.confidence * (seen.confidence > MIN_CONFIDENCE)
    drawn = torch.cat([unshaded + own + light.shade.log(), torch.ones_like(known)[:, None]], 1)
    around, near = inpaint(rest, faces, drawn, known, EDGE_DETAIL, JUST_BEHIND).split([3, 1], 1)
    wanted = _likely(around / near.clamp_min(MIN_PROXIMITY) - unshaded - own, -MAX_BEHIND, MAX_BEHIND)
    share = (1 - seen.confidence / MIN_CONFIDENCE).clamp(0, 1)[:, None] * near.clamp(0, 1)
    return light._replace(shade=torch.lerp(light.shade.log(), wanted, share).exp())
