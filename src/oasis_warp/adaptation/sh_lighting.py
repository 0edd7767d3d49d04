"""The light of a photo as spherical harmonics."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.avatar.anchors import rim_fade, vertex_to_gaussians
from oasis_warp.avatar.observation import Observation, observe
from oasis_warp.avatar.sky import arriving, harmonic_basis
from oasis_warp.avatar.vertex_light import GAMMA, Lighting, posed_lighting, shading
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.core.windows import mean_around
from oasis_warp.ops import BlendWeights, blend_colors, depth_map

MEAN_HARMONICS = (1.0, 0.0, -0.12, -0.35, 0.0, 0.0, 0.1, 0.0, 0.0)
"""Mean harmonics of the light where the tone of a photo is even: more from above, and more from the camera's side and
from behind than from the sides. A photo shows how skin darkens towards a slant, and not whether the back is as bright.
On 24 photos of tests/data/photos and its same_hand, skin at 57 degrees is darker than skin that faces the camera by .14
in log(sRGB), on fingers and on the hand. Fitted light gives .11 and .09; with -.15 and 0 instead of -.35 and .1 it
gave .08 and .06, and hands looked flat in other poses."""
HARMONICS_COVARIANCE = (
    (0.057, 0.0, -0.020, 0.036),
    (0.0, 0.080, 0.0, 0.0),
    (-0.020, 0.0, 0.132, -0.024),
    (0.036, 0.0, -0.024, 0.256),
)
SECOND_DEGREE = (0.140, 0.084, 0.011, 0.090, 0.034)
"""Covariance of the first four, and variances of the others. Those of degree 2 were measured in 3,000 synthetic rooms.
The first four, and a mean of -.15 along z, were measured in synthetic rooms, too, made symmetric in x, and the spread
of directions was doubled: of seven priors this one was chosen on 96 pairs of 32 photos of same_hand, by contrast and
PSNR. With the statistics of the rooms, which are dark behind the hand, these pairs lose 1.1 dB of PSNR."""
HUE_CORRELATION = 0.985
"""Correlation of a harmonic's three channels: rooms have dark and bright sides, but hardly any light is green on one
side and pink on the other. In 3,000 synthetic rooms it is .99; coloured walls near the hand leave some freedom."""
HIDDEN, OPEN = 0.4, 0.75
"""Shares of the sky below which skin in the photo shows nothing of its colour, and above which it shows all: between
bent fingers the light that arrives depends on a millimetre of the fit, and beside what hides it shadows are sharp."""
SHADED = 0.3
"""Logarithm of a vertex's shade from which it shows nothing of the colour: beside a dark crease that lies a pixel off,
the photo without that shade is as bright as the crease is dark."""
ROUNDS = 2
"""Fits of the light, each with the shares of the one before; a third changes shares by less than .01."""
ALBEDOS = 0.02, 0.8
"""Least and greatest reflectance of skin."""
PRIOR_WEIGHT = 0.01
"""Weight of this prior against a light that is seen in every direction: of .001, .003, .01, .03 and .1 the best for six
synthetic people whom no evaluation uses, by .06 dB and more."""
MIN_CONFIDENCE = 0.1
"""Confidence from which a vertex counts as visible."""
LIMIT_QUANTILES = 0.03, 0.97
"""Quantiles of the light on visible vertices, between which all light is clamped."""
WHITE_QUANTILE = 0.995
"""Quantile of unlit skin colours that is scaled to 1 where it exceeds it."""
MAX_LOG_SHADE = 3.0
"""Largest absolute logarithm of shade."""
DOUBT_PASSES = 12
"""Smoothings over the mesh, about 7 mm, of where the photo may show another part of the hand, and of as much beside it.
With a sharp border shadows had ragged edges where the view had changed by a few degrees."""
OCCLUDER_FADE = 0.001
"""Distance over which the shade of pixels that may not show the skin ends [m]."""
MIN_COLOR = 0.02
"""Colours are clamped to it before their logarithm is taken [sRGB]."""
MIN_LIGHT = 0.25
"""Least light relative to the mean, because colours are divided by it. With .05 the palm of one hand in low light from
one side was a dark patch beside a bright streak."""
OUTLINE_MARGIN = 1 / 32
"""Width over which light is continued beyond the outline of the surface, over the side of the picture."""


def fit_light(hand: HandModel, drawn: Float[Tensor, "H W 3"], crop: HandCrop) -> HandLight:
    """Fit the light in which `drawn` looks most like the photo.

    Weighted least squares of photo = drawn (h . b(n)) e over the visible vertices, in linear light, for all channels at
    once. The harmonics h are those of the irradiance up to degree 2 (Ramamoorthi and Hanrahan 2001), b the functions of
    `sky.harmonic_basis`. The share e of this light arrives past the hand in the photo's pose, so that soft shadows
    between fingers do not become skin. It depends on the light; the first round takes that of even light. A photo shows
    only skin that faces it, so a normal prior on the harmonics constrains the rest (maximum a posteriori). If nothing
    is visible, the light is even.

    Args:
        hand: Model of the surface.
        drawn: The hand in even light, in the photo's view; defined everywhere on the hand.
        crop: The photo.
    """
    seen, known = observe(hand, crop), observe(hand, crop._replace(image=drawn)).colors.clamp(0, 1) ** GAMMA
    shown = seen.confidence > MIN_CONFIDENCE
    even = _even_light(known[shown].mean(0) if bool(shown.any()) else known.mean(0))
    if not bool(shown.any()):
        return even
    rest, faces = crop.rest.vertices, hand.faces.to(known.device)
    light, on = even, posed_lighting(rest, crop.posed.vertices, faces, even)
    basis = harmonic_basis(on.normals, len(MEAN_HARMONICS))
    for _ in range(ROUNDS):
        weighted = seen._replace(confidence=seen.confidence * exposure_confidence(on))
        harmonics = _solve_harmonics(basis, known * _arriving(light, on), weighted)
        light = light._replace(harmonics=harmonics)
        on = posed_lighting(rest, crop.posed.vertices, faces, light)
    received, arriving = basis[shown] @ light.harmonics, _arriving(light, on)[shown]
    share = seen.confidence[shown, None]
    mean = ((received * arriving * share).sum(0) / share.sum()).clamp_min(MIN_LIGHT)
    limits = torch.stack([torch.quantile(received, level, dim=0) / mean for level in LIMIT_QUANTILES])
    relative = light._replace(harmonics=light.harmonics / mean, limits=limits.clamp_min(MIN_LIGHT))
    # Colours end at 1. If unlit skin were brighter, the whole light is scaled up instead.
    ratio = seen.colors[shown] / shading(relative, on)[shown]
    brightest = torch.quantile(ratio.amax(1), WHITE_QUANTILE).clamp_min(1) ** GAMMA
    return relative._replace(
        harmonics=relative.harmonics * brightest, limits=relative.limits * brightest, even=even.even * brightest
    )


def exposure_confidence(on: Lighting) -> Float[Tensor, "V"]:
    """How far the photo shows the colour of skin, by the share of the sky that the skin sees: 0 to 1."""
    if on.exposure is None:
        return torch.ones_like(on.normals[..., 0])
    t = ((on.exposure[..., 0] - HIDDEN) / (OPEN - HIDDEN)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def trust_in_albedo(hand: HandModel, crop: HandCrop, sure: HandCrop, light: HandLight) -> Float[Tensor, "V"]:
    """Probability that what a photo shows beyond a guess is skin, not shadow or another part of the hand: 0 to 1.

    Args:
        hand: Model of the surface.
        crop: The photo.
        sure: The same with the mask of `mask_unreliable`.
        light: Light of the photo.
    """
    on = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces.to(crop.image.device), light)
    every, reliable = (observe(hand, which).confidence for which in (crop, sure))
    trust = exposure_confidence(on) * _reliable_share(every, reliable)
    if light.shade is None:
        return trust
    return trust * (1 - light.shade.log().mean(-1).abs() / SHADED).clamp(0, 1)


def _reliable_share(every: Float[Tensor, "V"], reliable: Float[Tensor, "V"]) -> Float[Tensor, "V"]:
    """Confidence with the mask of reliable pixels, over that with the whole mask; 1 where the photo shows nothing."""
    return torch.where(every > 0, reliable / every.clamp_min(1e-6), 1).clamp(0, 1)


def _even_light(albedo: Float[Tensor, "3"]) -> HandLight:
    """Even light on skin of this mean reflectance."""
    harmonics = torch.zeros_like(albedo).repeat(len(MEAN_HARMONICS), 1)
    harmonics[0] = 1
    return HandLight(harmonics, torch.ones_like(harmonics[:2]), harmonics[0], albedo=albedo.clamp(*ALBEDOS))


def _arriving(light: HandLight, on: Lighting) -> Float[Tensor, "V 3"]:
    assert on.exposure is not None and light.albedo is not None, "this light is hidden by the hand"
    return arriving(on.exposure[..., 1:], light.albedo)


def _solve_harmonics(
    basis: Float[Tensor, "V 9"], reflected: Float[Tensor, "V 3"], seen: Observation
) -> Float[Tensor, "9 3"]:
    """The most likely harmonics of a photo, given the `reflected` colours under a light of 1 from all around."""
    weight, light = seen.confidence, seen.colors.clamp(0, 1) ** GAMMA
    terms = basis * reflected.T[..., None]  # of each channel, [3, V, 9]
    scale = (weight[:, None] * reflected.square()).sum(0).clamp_min(torch.finfo(reflected.dtype).eps)
    weighted = terms * weight[:, None] / scale[:, None, None]
    colors = torch.linalg.inv((1 - HUE_CORRELATION) * torch.eye(3) + HUE_CORRELATION * torch.ones(3, 3)).to(reflected)
    prior = torch.block_diag(reflected.new_tensor(HARMONICS_COVARIANCE), reflected.new_tensor(SECOND_DEGREE).diag())
    ridge = PRIOR_WEIGHT * torch.kron(colors, torch.linalg.inv(prior))
    right = (weighted.mT @ light.T[..., None]).flatten() + ridge @ reflected.new_tensor(MEAN_HARMONICS).repeat(3)
    return torch.linalg.solve(torch.block_diag(*(weighted.mT @ terms)) + ridge, right).view(3, -1).T


def add_shade(
    hand: HandModel, drawn: Float[Tensor, "H W 3"], crop: HandCrop, sure: HandCrop, light: HandLight
) -> HandLight:
    """Add a shade to `light` for its errors where the photo may show something else than the skin.

    Args:
        hand: Model of the surface.
        drawn: The hand in even light, in the photo's view; defined everywhere on the hand.
        crop: The photo.
        sure: The same with the mask of `mask_unreliable`.
        light: Light of the photo.
    """
    faces, rest = hand.faces.to(drawn.device), crop.rest.vertices
    lit = apply_light(hand, drawn, crop, light)
    seen, known = observe(hand, crop), observe(hand, crop._replace(image=lit)).colors
    missing = (seen.colors.clamp_min(MIN_COLOR) / known.clamp_min(MIN_COLOR)).log()
    on = posed_lighting(rest, crop.posed.vertices, faces, light)
    reliable = observe(hand, sure).confidence
    fade = rim_fade(rest[None], hand.rim.to(rest.device))[0]  # the arm has no shade
    doubt = (seen.confidence - reliable * exposure_confidence(on)) * fade
    occluded = inpaint(rest, faces, missing, doubt, OCCLUDER_FADE / 3, OCCLUDER_FADE)
    shade = occluded.clamp(-MAX_LOG_SHADE, MAX_LOG_SHADE).exp()
    elsewhere = 1 - _reliable_share(seen.confidence, reliable)[:, None]
    around = 2 * surface.smooth_over_mesh(elsewhere, surface.mesh_edges(faces), DOUBT_PASSES)
    return light._replace(shade=shade, facing=on.normals, doubt=around.clamp(max=1)[:, 0])


def shading_picture(hand: HandModel, crop: HandCrop, light: HandLight) -> Float[Tensor, "H W 3"]:
    """Factor of `light` on the colours of the photo of `crop`; continued a little beyond the hand, then 1."""
    camera, posed = crop.camera, crop.posed.vertices
    faces = hand.faces.to(posed.device)
    on = posed_lighting(crop.rest.vertices, posed, faces, light)
    factor = shading(light, on)
    if light.shade is not None:
        factor = factor * light.shade
    seen = depth_map(posed, faces, camera.viewmat, camera.K, camera.width, camera.height, validate=False)
    on_hand = (seen.face_ids >= 0).to(factor)[..., None]
    inside = (factor[faces[seen.face_ids.clamp_min(0).long()]] * seen.barycentrics[..., None]).sum(-2)
    # the outlines of picture and surface may differ by a few pixels
    planes = torch.cat([inside * on_hand, on_hand], -1).permute(2, 0, 1)
    spread = mean_around(planes, round(OUTLINE_MARGIN * camera.width)).permute(1, 2, 0)
    beyond = torch.where(spread[..., 3:] > 0, spread[..., :3] / spread[..., 3:].clamp_min(1e-6), 1)
    return torch.where(on_hand > 0, inside, beyond)


def without_light(hand: HandModel, crop: HandCrop, light: HandLight) -> HandCrop:
    """The same crop in even light; far from the hand nothing changes."""
    return crop._replace(image=(crop.image / shading_picture(hand, crop, light)).clamp(0, 1))


def apply_light(
    hand: HandModel, drawn: Float[Tensor, "H W 3"], crop: HandCrop, light: HandLight
) -> Float[Tensor, "H W 3"]:
    """`drawn`, a picture of `crop` in even light, in the given `light`."""
    return (drawn * shading_picture(hand, crop, light)).clamp(0, 1)


SHADING_LENGTH = 0.008
"""Variation over longer distances on the surface is shading: there the prior's error is smaller than the effect of
light in the most even photo [m]."""
SHADING_REACH = 0.1
"""Distance to which shading is continued beyond what is seen [m]."""
SKIN_DEVIATION = 0.007
"""Standard deviation of what a trained prior misses of creases, veins and spots [sRGB]. On synthetic people .003 loses
nothing against the prior's own colours and .007 up to .06 dB, but real skin has more to it."""


def match_light(
    image: Float[Tensor, "H W 3"],
    drawn: Float[Tensor, "H W 3"],
    missing: Float[Tensor, "V 3"],
    confidence: Float[Tensor, "V"],
    view: BlendWeights,
    gaussians: CanonicalGaussians,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
) -> Float[Tensor, "H W 3"]:
    """An estimate of the photo in the light of `drawn`.

    The part of the difference between photo and picture that is smooth along the surface counts as light and is
    removed. The rest has two sources: detail of the skin, and effects of light such as shaded creases, gloss and noise.
    A Wiener filter scales it by the share of its variance that skin detail has.

    Args:
        image: The photo.
        drawn: Picture of the calibrated prior.
        missing: `image - drawn` at the vertices.
        confidence: Confidence of the colours.
        view: View of `gaussians` in the photo.
        gaussians: Which `drawn` shows.
        vertices: The surface at rest [m].
        faces: Corners.
    """
    shading = inpaint(vertices, faces, missing, confidence, SHADING_LENGTH, SHADING_REACH)
    detail = weighted_deviation(missing - shading, confidence)
    share = (SKIN_DEVIATION / detail.clamp_min(SKIN_DEVIATION)).square()
    light = blend_colors(view, vertex_to_gaussians(shading, faces, gaussians))
    return drawn + share * (image - drawn - light)


def weighted_deviation(values: Float[Tensor, "V 3"], weight: Float[Tensor, "V"]) -> Tensor:
    """Weighted median of the values' magnitudes: a deviation that tattoos and highlights do not change."""
    size = values.square().mean(1).sqrt()
    order = size.argsort()
    below = weight[order].cumsum(0)
    return size[order][torch.searchsorted(below, below[-1] / 2).clamp_max(len(order) - 1)]
