"""Images of the hand in other poses for joint refinement: a prior's colours on the surface, lit as the photo is.

A prior's colours are those of even light, but most contrast inside the outline of a photo is shading: fingers are
cylinders, and shading jumps where one occludes another. So the light is estimated for every pose, as the logarithm of
nine spherical harmonics of the normal in each channel, by a small linear system.
"""

import functools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from oasis_warp.avatar.anchors import vertex_colors
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop
from oasis_warp.ops import depth_map

DARKEST = 0.02
"""Least brightness of colours whose logarithm is taken."""
RESIDUAL_SCALE = 0.15
"""Residual of the logarithm of a colour at which a pixel counts half: cast shadows and gloss are outliers."""
RIDGE = (0.0, 1e-3, 1e-3, 1e-3, 3e-3, 3e-3, 3e-3, 3e-3, 3e-3)
"""Ridge of each harmonic, as a fraction of the number of pixels: few normals do not determine a light."""
LIGHT_ROUNDS = 4
CERTAIN = 0.5
"""Coverage from which a pixel counts as hand."""


class RenderedSurface(NamedTuple):
    """The surface in B poses, without light."""

    covered: Float[Tensor, "B S S"]
    """1 where the surface is, 0 elsewhere."""
    albedo: Float[Tensor, "B S S 3"]
    normal: Float[Tensor, "B S S 3"]
    """Unit, of the faces, in the camera's frame."""


class ShadingScene(NamedTuple):
    """A photo, reduced to S pixels, and what is known about its hand."""

    image: Float[Tensor, "3 S S"]
    mask: Float[Tensor, "S S"]
    compared: Float[Tensor, "S S"]
    """1 above the wrist, where mask and surface should agree."""
    K: Float[Tensor, "3 3"]
    faces: Int[Tensor, "F 3"]
    albedo: Float[Tensor, "V 3"]
    """Colours of the vertices in even light."""


def shading_scene(
    hand: HandModel, guess: CanonicalGaussians, crop: HandCrop, compared: Float[Tensor, "s s"], size: int
) -> ShadingScene:
    """The photo of `crop` with `size` pixels; `compared` is as large as its mask."""

    def reduced(planes: Tensor) -> Tensor:
        return interpolate(planes[None], size=(size, size), mode="area")[0]

    K = crop.camera.K.clone()
    K[:2] *= size / crop.camera.width
    mask, line = reduced(torch.stack([crop.mask, compared]))
    albedo = vertex_colors(guess, len(hand.template)).clamp_min(DARKEST)
    return ShadingScene(reduced(crop.image.permute(2, 0, 1)), mask, line, K, hand.faces.to(mask.device), albedo)


def render_surface(scene: ShadingScene, posed: Float[Tensor, "B V 3"]) -> RenderedSurface:
    """The surface in B poses, in the camera's frame."""
    size = scene.mask.shape[0]
    viewmat = torch.eye(4, dtype=posed.dtype, device=posed.device)
    seen = depth_map(
        posed, scene.faces, viewmat, scene.K, size, size, outputs=("face_ids", "barycentrics"), validate=False
    )
    corners = scene.faces[seen.face_ids.clamp_min(0).long()]
    points = posed.gather(1, corners.flatten(1)[..., None].expand(-1, -1, 3)).view(*corners.shape, 3)
    a, b, c = points.unbind(-2)
    return RenderedSurface(
        (seen.face_ids >= 0).to(posed),
        (scene.albedo[corners] * seen.barycentrics[..., None]).sum(-2),
        normalize(torch.linalg.cross(b - a, c - a), dim=-1),
    )


def solve_light(scene: ShadingScene, rendered: RenderedSurface, pose: int) -> Float[Tensor, "9 3"]:
    """Logarithm of the light in which one of the poses looks most like the photo (reweighted least squares)."""
    weight = (scene.mask * scene.compared * rendered.covered[pose] > CERTAIN).to(scene.mask)[..., None]
    basis = harmonics(rendered.normal[pose])
    goal = (scene.image.permute(1, 2, 0).clamp_min(DARKEST) / rendered.albedo[pose].clamp_min(DARKEST)).log()
    basis, goal, inside = basis.flatten(0, 1), goal.flatten(0, 1), weight.flatten(0, 1)
    ridge = torch.diag(basis.new_tensor(RIDGE)) * inside.sum() + 1e-6 * torch.eye(9, device=basis.device)
    weight = inside
    for _ in range(LIGHT_ROUNDS):
        weighted = basis * weight
        light = torch.linalg.solve(weighted.T @ basis + ridge, weighted.T @ goal)
        residual = (goal - basis @ light).abs().mean(1, keepdim=True)
        weight = inside / (1 + (residual / RESIDUAL_SCALE) ** 2)
    return light


def harmonics(normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """Real spherical harmonics up to degree 2, not normalised."""
    x, y, z = normal.unbind(-1)
    return torch.stack(
        [torch.ones_like(x), x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1
    )


def detail_gap(
    scene: ShadingScene, rendered: RenderedSurface, light: Float[Tensor, "9 3"], fine: float, coarse: float
) -> Float[Tensor, "B 3 S S"]:
    """Photo minus image, band-passed by two blurs (standard deviations in pixels), inside both mask and surface.

    Differences that vary more slowly than the coarse blur are light beyond harmonics, above all shadows.
    """
    image = rendered.albedo * (harmonics(rendered.normal) @ light).clamp(-2, 2).exp()
    both = (scene.mask * scene.compared * rendered.covered)[:, None]
    gap = both * (scene.image - image.permute(0, 3, 1, 2))
    return _mean_around(gap, both, fine) - _mean_around(gap, both, coarse)


def outline_gap(scene: ShadingScene, rendered: RenderedSurface, width: float) -> Float[Tensor, "B S S"]:
    """Blurred surface minus blurred mask above the wrist, which grows with the distance of the outlines."""
    return (blur(rendered.covered[:, None], width)[:, 0] - blur(scene.mask[None, None], width)[0]) * scene.compared


def _mean_around(values: Tensor, weight: Tensor, width: float) -> Tensor:
    return blur(values, width) / blur(weight, width).clamp_min(0.1)


def blur(planes: Float[Tensor, "B C H W"], width: float) -> Float[Tensor, "B C H W"]:
    """Convolution with a Gaussian of standard deviation `width` [px, at least 1]; black surrounds the image.

    Computed as matrix products: on a CPU, convolutions of single channels take three times as long.
    """
    down, across = (_gaussian(size, width).to(planes) for size in planes.shape[-2:])
    return down @ planes @ across


@functools.cache
def _gaussian(size: int, width: float) -> Float[Tensor, "n n"]:
    t = torch.arange(size, dtype=torch.float64)
    return torch.exp(-((t - t[:, None]) ** 2) / (2 * width * width)) / (width * math.sqrt(2 * math.pi))
