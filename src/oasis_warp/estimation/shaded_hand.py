"""What the photo would show if the hand were in another pose: a prior's colours on the surface, lit as the photo is.

A prior draws hands in even light, and most of what a photo shows inside the outline is light: fingers are cylinders,
and where one hides another the shading jumps. The light is therefore solved for with every pose, nine spherical
harmonics of the normal in each channel, which a small matrix does.
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
"""Colours are taken to be at least this bright where their logarithm is asked for."""
SHADE = 0.15
"""Logarithm of a colour by which a pixel may miss the light and still count for it: cast shadows and gloss do not."""
FLATTEST = (0.0, 1e-3, 1e-3, 1e-3, 3e-3, 3e-3, 3e-3, 3e-3, 3e-3)
"""How strongly each harmonic is drawn to zero, in shares of the pixels: few normals do not tell a light."""
LIGHT_ROUNDS = 4
CERTAIN = 0.5
"""Share of a pixel from which it counts as hand."""


class Drawn(NamedTuple):
    """B poses of one hand, before they are lit."""

    covered: Float[Tensor, "B S S"]
    """1 where the surface is, 0 elsewhere."""
    albedo: Float[Tensor, "B S S 3"]
    normal: Float[Tensor, "B S S 3"]
    """Unit, of the faces, in the camera's frame."""


class Scene(NamedTuple):
    """A photo, reduced to S pixels, and what is known of its hand."""

    image: Float[Tensor, "3 S S"]
    mask: Float[Tensor, "S S"]
    judged: Float[Tensor, "S S"]
    """1 where mask and surface are to agree: above the wrist."""
    K: Float[Tensor, "3 3"]
    faces: Int[Tensor, "F 3"]
    albedo: Float[Tensor, "V 3"]
    """Colours of the vertices in even light."""


def make_scene(
    hand: HandModel, guess: CanonicalGaussians, crop: HandCrop, judged: Float[Tensor, "s s"], size: int
) -> Scene:
    """The photo of `crop` with `size` pixels; `judged` is as large as its mask."""

    def reduced(planes: Tensor) -> Tensor:
        return interpolate(planes[None], size=(size, size), mode="area")[0]

    K = crop.camera.K.clone()
    K[:2] *= size / crop.camera.width
    mask, line = reduced(torch.stack([crop.mask, judged]))
    albedo = vertex_colors(guess, len(hand.template)).clamp_min(DARKEST)
    return Scene(reduced(crop.image.permute(2, 0, 1)), mask, line, K, hand.faces.to(mask.device), albedo)


def draw(scene: Scene, posed: Float[Tensor, "B V 3"]) -> Drawn:
    """The surface in B poses, in the camera's frame."""
    size = scene.mask.shape[0]
    still = torch.eye(4, dtype=posed.dtype, device=posed.device)
    seen = depth_map(
        posed, scene.faces, still, scene.K, size, size, outputs=("face_ids", "barycentrics"), validate=False
    )
    corners = scene.faces[seen.face_ids.clamp_min(0).long()]
    places = posed.gather(1, corners.flatten(1)[..., None].expand(-1, -1, 3)).view(*corners.shape, 3)
    a, b, c = places.unbind(-2)
    return Drawn(
        (seen.face_ids >= 0).to(posed),
        (scene.albedo[corners] * seen.barycentrics[..., None]).sum(-2),
        normalize(torch.linalg.cross(b - a, c - a), dim=-1),
    )


def solve_light(scene: Scene, drawn: Drawn, pose: int) -> Float[Tensor, "9 3"]:
    """Logarithm of the light that makes one of the poses look most like the photo (iterated least squares)."""
    weight = (scene.mask * scene.judged * drawn.covered[pose] > CERTAIN).to(scene.mask)[..., None]
    basis = harmonics(drawn.normal[pose])
    goal = (scene.image.permute(1, 2, 0).clamp_min(DARKEST) / drawn.albedo[pose].clamp_min(DARKEST)).log()
    basis, goal, inside = basis.flatten(0, 1), goal.flatten(0, 1), weight.flatten(0, 1)
    held = torch.diag(basis.new_tensor(FLATTEST)) * inside.sum() + 1e-6 * torch.eye(9, device=basis.device)
    weight = inside
    for _ in range(LIGHT_ROUNDS):
        weighted = basis * weight
        light = torch.linalg.solve(weighted.T @ basis + held, weighted.T @ goal)
        miss = (goal - basis @ light).abs().mean(1, keepdim=True)
        weight = inside / (1 + (miss / SHADE) ** 2)
    return light


def harmonics(normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """Real spherical harmonics up to degree 2, not normalised."""
    x, y, z = normal.unbind(-1)
    return torch.stack(
        [torch.ones_like(x), x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1
    )


def detail_gap(
    scene: Scene, drawn: Drawn, light: Float[Tensor, "9 3"], fine: float, coarse: float
) -> Float[Tensor, "B 3 S S"]:
    """Photo less picture, between two blurs (standard deviations in pixels), inside both mask and surface.

    What changes slower than the coarse blur is light that harmonics do not tell, shadows above all.
    """
    picture = drawn.albedo * (harmonics(drawn.normal) @ light).clamp(-2, 2).exp()
    both = (scene.mask * scene.judged * drawn.covered)[:, None]
    gap = both * (scene.image - picture.permute(0, 3, 1, 2))
    return _mean_around(gap, both, fine) - _mean_around(gap, both, coarse)


def outline_gap(scene: Scene, drawn: Drawn, width: float) -> Float[Tensor, "B S S"]:
    """Surface less mask above the wrist, both blurred [px]: across an outline that is off, less than its offset."""
    return (blur(drawn.covered[:, None], width)[:, 0] - blur(scene.mask[None, None], width)[0]) * scene.judged


def _mean_around(values: Tensor, weight: Tensor, width: float) -> Tensor:
    return blur(values, width) / blur(weight, width).clamp_min(0.1)


def blur(planes: Float[Tensor, "B C H W"], width: float) -> Float[Tensor, "B C H W"]:
    """Convolution with a Gaussian of standard deviation `width` [px, at least 1]; black surrounds the picture.

    As products with matrices: a CPU convolves planes of one channel three times as slowly.
    """
    down, across = (_gaussian(size, width).to(planes) for size in planes.shape[-2:])
    return down @ planes @ across


@functools.cache
def _gaussian(size: int, width: float) -> Float[Tensor, "n n"]:
    t = torch.arange(size, dtype=torch.float64)
    return torch.exp(-((t - t[:, None]) ** 2) / (2 * width * width)) / (width * math.sqrt(2 * math.pi))
