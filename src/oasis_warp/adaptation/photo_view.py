"""The photo's own view as the photo shows it, by the shade that fades everywhere else."""

import torch

from oasis_warp.adaptation.sharpen import lit_as_photo
from oasis_warp.avatar.anchors import rim_fade, vertex_to_gaussians
from oasis_warp.avatar.observation import faded_in
from oasis_warp.avatar.pose import pose_gaussians, posed_lighting
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.ops import blend_colors
from oasis_warp.render import view_weights

ROUNDS, OVERSHOOT = 8, 1.5
"""Steps towards the photo, and how much longer each is than the mean of what is missing."""
BORDER = 3 / 256
"""Share of the photo's side, at the mask's border, that may hold background, and over which pixels count more."""
WRIST = 0.02
"""Distance from the wrist's end up to which nothing changes, and over which the change grows [m]."""
FEWEST = 0.05
"""Least sum of a Gaussian's weights over the pixels that count: less says nothing about its colour."""
MIN_COLOR = 0.01
"""Least colour whose logarithm is taken."""
MOST = 3.0
"""Largest logarithm by which shade changes."""


@torch.no_grad()
def match_photo(
    hand: HandModel, gaussians: CanonicalGaussians, crop: HandCrop, light: HandLight
) -> CanonicalGaussians:
    """Change the shade of Gaussians until their picture is the photo.

    Where the photo may show something else than the fitted skin, that skin keeps its own colours; in the photo's own
    view these were cracks and double contours beside fingers. Each step moves the colour of a Gaussian, as the photo
    shows it, by the mean of what its pixels miss, weighted as they blend it (SIRT, Gilbert 1972). All of it is shade,
    which goes as the hand or the camera moves.

    Args:
        hand: Model of the surface.
        gaussians: Adapted to the photo, with unseen skin painted; as they are if they have no shade.
        crop: The photo.
        light: Its light.
    """
    if gaussians.shade is None:
        return gaussians
    rest, posed = crop.rest.vertices, crop.posed.vertices
    faces = hand.faces.to(rest.device)
    lit = lit_as_photo(gaussians, faces, light, posed_lighting(rest, posed, faces, light))
    weights = view_weights(pose_gaussians(lit, faces, rest, posed), crop.camera)
    counts = faded_in(crop.mask, BORDER)[..., None]
    total = weights.transpose @ counts.view(-1, 1)
    known = total > FEWEST
    goal, colors = crop.image * weights.alphas, lit.colors
    for _ in range(ROUNDS):
        missing = (goal - blend_colors(weights, colors)) * counts
        step = (weights.transpose @ missing.view(-1, 3)) / total.clamp_min(FEWEST)
        colors = (colors + OVERSHOOT * step * known).clamp(0, 1)
    fade = rim_fade(rest[None], hand.rim.to(rest.device), WRIST, WRIST)[0, :, None]
    change = (colors.clamp_min(MIN_COLOR) / lit.colors.clamp_min(MIN_COLOR)).log().clamp(-MOST, MOST)
    change = change * vertex_to_gaussians(fade, faces, gaussians)
    return gaussians._replace(shade=gaussians.shade * change.exp())
