"""Tell skin from light: how much of what a photo shows beyond a prior belongs to the hand, and not to its light."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.observation import Observation
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.ops import BlendWeights, blend_colors

LIGHT_LENGTH = 0.008
"""What changes over longer ways on the surface is shading: there the prior's error is smaller than what light does in
the most even photo [m]."""
REACH = 0.1
"""Distance to which shading is continued beyond what is seen [m]."""
SKIN_DEVIATION = 0.007
"""Standard deviation of what a trained prior misses of creases, veins and spots [sRGB]. On synthetic people .003 loses
nothing against the prior's own colours and .007 up to .06 dB, but real skin has more to it."""


def even_photo(
    image: Float[Tensor, "H W 3"],
    drawn: Float[Tensor, "H W 3"],
    missing: Observation,
    view: BlendWeights,
    gaussians: CanonicalGaussians,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
) -> Float[Tensor, "H W 3"]:
    """The photo as it would be in the light of `drawn`, as far as one can tell.

    Of the difference between photo and picture, what is smooth along the surface is taken for light and left out. Of
    the rest light makes its share too: shaded creases, gloss, noise. It adds to the variance of the skin's own detail,
    so the best guess (Wiener's) keeps that variance's share of it.

    Args:
        image: The photo.
        drawn: The prior's picture in the photo's tone.
        missing: `image - drawn` at the vertices.
        view: Of `gaussians` in the photo.
        gaussians: Which `drawn` shows.
        vertices: The surface at rest [m].
        faces: Corners.
    """
    shading = inpaint(vertices, faces, missing.colors, missing.confidence, LIGHT_LENGTH, REACH)
    detail = weighted_deviation(missing.colors - shading, missing.confidence)
    share = (SKIN_DEVIATION / detail.clamp_min(SKIN_DEVIATION)).square()
    light = blend_colors(view, vertex_to_gaussians(shading, faces, gaussians))
    return drawn + share * (image - drawn - light)


def weighted_deviation(values: Float[Tensor, "V 3"], weight: Float[Tensor, "V"]) -> Tensor:
    """Standard deviation of what most values do: a tattoo or a highlight is no measure of the rest."""
    size = values.square().mean(1).sqrt()
    order = size.argsort()
    below = weight[order].cumsum(0)
    return size[order][torch.searchsorted(below, below[-1] / 2).clamp_max(len(order) - 1)]
