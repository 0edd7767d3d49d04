"""The light of a photo: fitted spherical harmonics; what the photo shows beyond them, split in albedo and shade.

Two photos of one hand agree on little of what they show beyond the prior. Where skin faces as before, a third to a half
of it is found again; where it has turned by more than 45 degrees, a tenth at most (docs/avatar.md). The
rest is shadows, gloss, wrinkles of the pose, and detail beside its place. So most of it is shade, which the photo's own
view keeps and other poses lose. Only what no light does to skin is taken for a mark, and stays whole.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.pose import GAMMA, posed_normals, shading, shading_picture, split_shade
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.ops import BlendWeights, blend_colors

USUAL = (1.0, 0.0, -0.12, -0.15)
"""Harmonics that light has in the mean where a photo's tone is even: more from above, and from the camera's side."""
SPREAD = (
    (0.057, 0.0, -0.010, 0.018),
    (0.0, 0.020, 0.0, 0.0),
    (-0.010, 0.0, 0.033, -0.006),
    (0.018, 0.0, -0.006, 0.064),
)
"""Their covariance. Both are those of 40 synthetic rooms, made alike left and right."""
HUE = 0.95
"""Correlation of a harmonic's three colours: rooms have dark and bright sides, but hardly any light is green on one
side and pink on the other. In 3,000 synthetic rooms it is .99; coloured walls near the hand are left some room."""
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

    Weighted least squares of photo = drawn (h_0 + h . n) over the vertices that the photo shows, in linear light of
    three colours: the first two bands of the harmonics of irradiance (Ramamoorthi and Hanrahan 2001). A photo
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
    terms = basis * known.T[..., None]  # of each colour, [3, V, 4]
    scale = (weight[:, None] * known.square()).sum(0).clamp_min(torch.finfo(known.dtype).eps)
    weighted = terms * weight[:, None] / scale[:, None, None]
    colors = torch.linalg.inv((1 - HUE) * torch.eye(3) + HUE * torch.ones(3, 3)).to(known)
    ridge = RIDGE * torch.kron(colors, torch.linalg.inv(known.new_tensor(SPREAD)))
    right = (weighted.mT @ light.T[..., None]).flatten() + ridge @ known.new_tensor(USUAL).repeat(3)
    harmonics = torch.linalg.solve(torch.block_diag(*(weighted.mT @ terms)) + ridge, right).view(3, 4).T
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


def add_shade(
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


LIGHT_LENGTH = 0.008
"""What changes over longer ways on the surface is shading: there the prior's error is smaller than what light does in
the most even photo [m]."""
EVEN_REACH = 0.1
"""Distance to which shading is continued beyond what is seen [m]."""
SKIN_DEVIATION = 0.007
"""Standard deviation of what a trained prior misses of creases, veins and spots [sRGB]. On synthetic people .003 loses
nothing against the prior's own colours and .007 up to .06 dB, but real skin has more to it."""


def light_evenly(
    image: Float[Tensor, "H W 3"],
    drawn: Float[Tensor, "H W 3"],
    missing: Float[Tensor, "V 3"],
    confidence: Float[Tensor, "V"],
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
        confidence: Of that.
        view: Of `gaussians` in the photo.
        gaussians: Which `drawn` shows.
        vertices: The surface at rest [m].
        faces: Corners.
    """
    shading = inpaint(vertices, faces, missing, confidence, LIGHT_LENGTH, EVEN_REACH)
    detail = weighted_deviation(missing - shading, confidence)
    share = (SKIN_DEVIATION / detail.clamp_min(SKIN_DEVIATION)).square()
    light = blend_colors(view, vertex_to_gaussians(shading, faces, gaussians))
    return drawn + share * (image - drawn - light)


def weighted_deviation(values: Float[Tensor, "V 3"], weight: Float[Tensor, "V"]) -> Tensor:
    """Standard deviation of what most values do: a tattoo or a highlight is no measure of the rest."""
    size = values.square().mean(1).sqrt()
    order = size.argsort()
    below = weight[order].cumsum(0)
    return size[order][torch.searchsorted(below, below[-1] / 2).clamp_max(len(order) - 1)]


STAYS = 0.2
"""Share of what is no mark that is taken for skin."""
ACROSS = ((-18.0, 21.3, -7.5), (8.8, 4.6, -8.1))
"""What light does to skin lies along one line in the logarithms of colours, from dark and red to bright and pale. These
are directions across it, over the standard deviations there, on photos of bare hands (`measure_persistence`)."""
MARK = 3.5, 7.0
"""Standard deviations across from which a difference is less likely shade, and from which it is a mark: 98 in 100
vertices of bare skin are below the first; half-transparent ink has 5, ink 15, red polish 24."""
BRIGHT = 0.45, 0.7
"""The same for what is brighter, in the mean of the logarithms: 99 in 100 of bare skin are below the first."""
MOST = 1.5
"""Largest logarithm of shade."""


def split_albedo_shading(
    hand: HandModel, guess: Float[Tensor, "N 3"], learned: CanonicalGaussians
) -> CanonicalGaussians:
    """The learned Gaussians with part of their looks as shade; together colours and shade are as before.

    Args:
        hand: Whose surface it is.
        guess: Colours of the Gaussians before they were learned.
        learned: In even light.
    """
    beyond = (learned.colors.clamp_min(DARK) / guess.clamp_min(DARK)).log().clamp(-MOST, MOST)
    of_vertices = vertex_colors(learned._replace(colors=beyond), len(hand.template))
    sure = vertex_to_gaussians(marks(of_vertices), hand.faces.to(guess.device), learned)
    colors, shade = split_shade(learned.colors, ((1 - STAYS) * (1 - sure) * beyond).exp())
    return learned._replace(colors=colors, shade=shade)


def marks(beyond: Float[Tensor, "V 3"]) -> Float[Tensor, "V 1"]:
    """0 to 1: how surely a difference of the logarithms of colours is a mark on the skin, rather than light."""
    across = (beyond @ beyond.new_tensor(ACROSS).T).norm(dim=-1)
    sure = [
        ((measure - least) / (most - least)).clamp(0, 1)
        for measure, (least, most) in ((across, MARK), (beyond.mean(-1), BRIGHT))
    ]
    return torch.maximum(*sure)[:, None]
