"""What a photo says about points of the posed surface: their colours, and how far to trust them."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, HandCrop
from oasis_warp.ops import depth_visibility

RIM_PIXELS = 2
"""Pixels inside the mask's border that may hold some background."""
VISIBILITY_MARGIN = 0.0015
"""Depth by which a vertex may lie behind the depth buffer and still be seen [m]. Vertices are visible by identity, so
that a third of the usual margin is enough; finger tips are thinner than the usual one."""
GRAZING, FACING = 0.15, 0.45
"""Cosines between the normal and the view below which a point says nothing and above which it is fully trusted."""


class Observation(NamedTuple):
    """Colours read off the photo at the vertices of the surface."""

    colors: Float[Tensor, "V 3"]
    confidence: Float[Tensor, "V"]
    """0 unseen, 1 seen well: visible, facing the camera and clear of the mask's border."""


def inner_mask(mask: Float[Tensor, "S S"], pixels: int = RIM_PIXELS) -> Float[Tensor, "S S"]:
    """The mask without its outermost `pixels`."""
    return -max_pool2d(-mask[None, None], 2 * pixels + 1, stride=1, padding=pixels)[0, 0]


def _sample(planes: Float[Tensor, "C S S"], uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N C"]:
    size = planes.shape[-1]
    grid = (uv / size * 2 - 1)[None, None]
    return grid_sample(planes[None], grid, align_corners=False)[0, :, 0].T


def facing(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], camera: Camera
) -> Float[Tensor, "V"]:
    """Cosine between each vertex's normal and its direction to the camera: negative where it turns away."""
    center = -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    return (surface.vertex_normals(vertices, faces) * normalize(center - vertices, dim=-1)).sum(-1)


def observe(hand: HandModel, crop: HandCrop) -> Observation:
    """Read the photo at every vertex, by projection and the depth buffer of the posed surface."""
    vertices, camera = crop.posed.vertices, crop.camera
    faces = hand.faces.to(vertices.device)
    visible, _, _ = depth_visibility(
        vertices, vertices, faces, camera.K, camera.viewmat, camera.width, camera.height, margin=VISIBILITY_MARGIN,
        point_vertices=torch.arange(len(vertices), device=vertices.device),
    )  # fmt: skip
    uv, _ = project(camera, vertices)
    trust = ((facing(vertices, faces, camera) - GRAZING) / (FACING - GRAZING)).clamp(0, 1)
    planes = torch.cat([crop.image.permute(2, 0, 1), inner_mask(crop.mask)[None]])
    sampled = _sample(planes, uv)
    return Observation(sampled[:, :3], visible * trust * sampled[:, 3].clamp(0, 1))
