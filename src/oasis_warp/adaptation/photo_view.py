"""The photos' own views as the photos show them, by the shade that fades everywhere else."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.sharpen import lit_as_photo
from oasis_warp.avatar.anchors import rim_fade, vertex_to_gaussians
from oasis_warp.avatar.observation import faded_in
from oasis_warp.avatar.pose import pose_gaussians, posed_lighting
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.ops import BlendWeights, blend_colors
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


class _View(NamedTuple):
    """A photo's view before its match."""

    weights: BlendWeights
    colors: Float[Tensor, "N 3"]
    """Of the Gaussians, in the photo's light."""
    counts: Float[Tensor, "H W 1"]
    """How much each pixel counts."""
    total: Float[Tensor, "N 1"]
    """Sum of each Gaussian's weights over these pixels."""


@torch.no_grad()
def match_photos(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    crops: Sequence[HandCrop],
    lights: Sequence[HandLight],
    gains: Float[Tensor, "K 3"],
) -> CanonicalGaussians:
    """Change the shade of Gaussians until their pictures are the photos.

    Where the photo may show something else than the fitted skin, that skin keeps its own colours; in the photo's own
    view these were cracks and double contours beside fingers. Each step moves the colour of a Gaussian, as the photo
    shows it, by the mean of what its pixels miss, weighted as they blend it (SIRT, Gilbert 1972). Several photos share
    a Gaussian as the squares of the weights that it has in each: nearly all of it goes to the one that shows it best.
    All of it is shade, which goes as the hand or the camera moves.

    Args:
        hand: Model of the surface.
        gaussians: Adapted to the photos, with unseen skin painted; as they are if they have no shade.
        crops: K photos, with one surface at rest.
        lights: Light of each.
        gains: How many times as bright as the first each is.
    """
    if gaussians.shade is None:
        return gaussians
    rest, faces = crops[0].rest.vertices, hand.faces.to(crops[0].image.device)
    views = [_view(gaussians, faces, *each) for each in zip(crops, lights, gains, strict=True)]
    squares = torch.stack([view.total.square() for view in views])
    shares = squares / squares.sum(0).clamp_min(FEWEST**2)
    logs = sum(_missing(view, crop, share) for view, crop, share in zip(views, crops, shares, strict=True))
    fade = rim_fade(rest[None], hand.rim.to(rest.device), WRIST, WRIST)[0, :, None]
    return gaussians._replace(shade=gaussians.shade * (logs * vertex_to_gaussians(fade, faces, gaussians)).exp())


def _view(
    gaussians: CanonicalGaussians, faces: Tensor, crop: HandCrop, light: HandLight, gain: Float[Tensor, "3"]
) -> _View:
    rest, posed = crop.rest.vertices, crop.posed.vertices
    lit = lit_as_photo(gaussians, faces, light, posed_lighting(rest, posed, faces, light))
    colors = (lit.colors * gain).clamp(0, 1)
    weights = view_weights(pose_gaussians(lit, faces, rest, posed), crop.camera)
    counts = faded_in(crop.mask, BORDER)[..., None]
    return _View(weights, colors, counts, weights.transpose @ counts.view(-1, 1))


def _missing(view: _View, crop: HandCrop, share: Float[Tensor, "N 1"]) -> Float[Tensor, "N 3"]:
    """What the logarithms of the Gaussians' colours miss in a photo, as far as that photo's `share` goes."""
    weights, start, counts, total = view
    goal, colors, share = crop.image * weights.alphas, start, share * (total > FEWEST)
    for _ in range(ROUNDS):
        missing = (goal - blend_colors(weights, colors)) * counts
        step = (weights.transpose @ missing.view(-1, 3)) / total.clamp_min(FEWEST)
        colors = (colors + OVERSHOOT * step * share).clamp(0, 1)
    return (colors.clamp_min(MIN_COLOR) / start.clamp_min(MIN_COLOR)).log().clamp(-MOST, MOST)
