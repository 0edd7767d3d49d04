"""The smooth part of shade, held by the vertices: it goes on behind what a photo shows, and ends in other poses."""

import torch

from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.vertex_light import posed_lighting, shading
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight

SMOOTH, REACH = 0.004, 0.04
"""Length below which shade is fine, and distance over which smooth shade is forgotten behind what the photo shows [m].
With 5 mm a dark rim kept an edge to the skin behind it. Set, as all below, on 13 photos of same_hand."""
RIM_WEIGHT = 0.3
"""Confidence at least of what the photo shows on a slant: painted skin begins there."""
DARKEST, BRIGHTEST, MAX_HUE = -0.5, 0.3, 0.1
"""Range of the logarithm of smooth shade, and of each channel's difference from the mean of all."""
BRIGHTEST_BEHIND = 0.1
"""Largest logarithm of it behind what the photo shows: with `BRIGHTEST` a stranger saw bleached flanks of fingers in
four of the photos in docs/looks.md."""
MAX_FINE = 0.1
"""Logarithm that fine shade tends to: more is the edge of a shadow, which would stay on the palm without its shadow."""
MAX_MOVED = 1.0
"""Largest logarithm that is moved: more is another part of the hand. With less, orange flecks stayed in hollows."""
BEHIND_PASSES = 2
"""Smoothings over the mesh of the border to what the photo shows."""
SHADOW, SHADOW_REACH = 0.003, 0.012
"""Where the photo may show another part of the hand: the length over which shadows are smoothed, because a fit is some
pixels off and both sides of a dark gap are dark; and how far shadows go on behind what the photo shows [m]."""
DARKEST_SHADOW, SHADOW_HUE = -1.2, (0.87, 1.01, 1.12)
"""Least logarithm of such a shadow, and that of red, green and blue over it: half as warm as in photos
(docs/looks_choices.md)."""
IN_SHADOW, IN_THE_OPEN = 0.65, 0.95
"""Shares of the sky that skin sees up to which such a shadow is kept, and from which it is not. Set by eye, as the four
above, on 6 photos (docs/looks_choices.md): .4 and .75 lost the shadow below a thumb."""


def spread_shade(
    hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, light: HandLight
) -> tuple[CanonicalGaussians, HandLight]:
    """Move the smooth part of the Gaussians' shade to the light's, and continue it behind what the photo shows.

    The albedo that is fitted to a photo hardly varies over more than a centimetre, but the shade does. It ended where
    the photo does, which was an edge between two tones from the side. In other poses it stayed on a palm and went from
    the fingers. The shade of the light ends on the whole hand at once (`avatar.vertex_light.remaining_shade`), and that
    of the Gaussians where skin turns. Where the photo may show another part of the hand, the light gets what continues
    the skin around, or a soft shadow where the photo is darker; all that the photo shows beyond that stays with the
    Gaussians, and ends in next to any other view. The photo's view stays.

    Args:
        hand: Model of the surface.
        gaussians: Adapted to the photos.
        crop: The first photo.
        light: Its light.
    """
    if gaussians.shade is None or light.shade is None:
        return gaussians, light
    rest, faces, seen = crop.rest.vertices, hand.faces.to(crop.image.device), observe(hand, crop)
    own = vertex_colors(gaussians._replace(colors=gaussians.shade.log()), len(rest))
    total = own + light.shade.log()
    grey = total.mean(-1, keepdim=True)
    likely = grey.clamp(DARKEST, BRIGHTEST) + (total - grey).clamp(-MAX_HUE, MAX_HUE)
    shown = seen.visibility * (seen.facing > 0)
    doubt = shown.new_zeros(1) if light.doubt is None else light.doubt
    known = torch.maximum(seen.confidence, RIM_WEIGHT * shown)
    smooth = inpaint(rest, faces, likely, known * (1 - doubt), SMOOTH, REACH)
    on = posed_lighting(rest, crop.posed.vertices, faces, light)
    if on.exposure is not None:
        dark = inpaint(rest, faces, grey.clamp(DARKEST_SHADOW, 0), known, SHADOW, SHADOW_REACH)
        shadow = torch.minimum(smooth, dark * dark.new_tensor(SHADOW_HUE))
        covered = ((IN_THE_OPEN - on.exposure[:, 0]) / (IN_THE_OPEN - IN_SHADOW)).clamp(0, 1)
        covered = covered * doubt * (1 - hand.nail.to(doubt))  # dark nails look bruised
        smooth = torch.lerp(smooth, shadow, covered[:, None])
    hidden = 1 - shown[:, None]
    hidden = torch.minimum(surface.smooth_over_mesh(hidden, surface.mesh_edges(faces), BEHIND_PASSES), hidden)
    fine = MAX_FINE * torch.tanh((total - smooth) / MAX_FINE)
    to_light = torch.lerp((own - fine).clamp(-MAX_MOVED, MAX_MOVED), smooth - light.shade.log(), doubt[:, None])
    moved = light.shade * ((1 - hidden) * to_light).exp()
    # Not exp(moved) itself: light is read between vertices as a factor, and the photo's view must not change.
    lit = shading(light, on)
    before, after = vertex_to_gaussians(torch.cat([lit * light.shade, lit * moved], 1), faces, gaussians).split(3, 1)
    behind = moved * (hidden * (smooth.clamp_max(BRIGHTEST_BEHIND) - light.shade.log())).exp()
    return gaussians._replace(shade=gaussians.shade * before / after), light._replace(shade=behind)
