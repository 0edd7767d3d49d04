"""What photos show at the vertices of the posed surface: their colours, and how far to trust them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, HandCrop, TrainingBatch
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


class NetworkInput(NamedTuple):
    """B square crops with the surfaces fitted to them; fields as in `TrainingBatch`."""

    image: Float[Tensor, "B S S 3"]
    mask: Float[Tensor, "B S S"]
    posed: Float[Tensor, "B V 3"]
    viewmat: Float[Tensor, "B 4 4"]
    K: Float[Tensor, "B 3 3"]
    rest: Float[Tensor, "B V 3"]


def input_of_crop(crop: HandCrop) -> NetworkInput:
    """One hand as a batch of one."""
    camera = crop.camera
    parts = (
        crop.image, crop.mask, crop.posed.vertices, camera.viewmat, camera.K, crop.rest.vertices,
    )  # fmt: skip
    return NetworkInput(*(part.to(crop.image)[None] for part in parts))


def input_of_batch(batch: TrainingBatch) -> NetworkInput:
    """The photos of a training batch, without its targets."""
    return NetworkInput(*batch[: len(NetworkInput._fields)])


class Sighting(NamedTuple):
    """The vertices of B hands in their photos."""

    uv: Float[Tensor, "B V 2"]
    """Projections; the image's corners at 0 and 1."""
    inside: Bool[Tensor, "B V"]
    """Whether they fall into the image, in front of the camera."""
    visibility: Float[Tensor, "B V"]
    """Equation 4; 0 where not inside."""
    colors: Float[Tensor, "B V 3"]
    """Read off the photo."""
    confidence: Float[Tensor, "B V"]
    """1 where that is skin of this very point: visible, facing the camera, clear of the mask's border."""


NEAR = 0.01
"""Depth up to which a point counts as behind the camera [m]."""


def project_batch(
    points: Float[Tensor, "B P 3"], viewmat: Float[Tensor, "B 4 4"], K: Float[Tensor, "B 3 3"], size: int
) -> tuple[Float[Tensor, "B P 2"], Bool[Tensor, "B P"]]:
    """Where points fall in a square image of `size` pixels, its corners at 0 and 1, and which fall inside.

    A point behind the camera is not inside and lies at (0, 0).
    """
    local = points @ viewmat[:, :3, :3].transpose(1, 2) + viewmat[:, None, :3, 3]
    in_front = local[..., 2] > NEAR
    homogeneous = local @ K.transpose(1, 2)
    uv = homogeneous[..., :2] / torch.where(in_front, homogeneous[..., 2], 1)[..., None] / size
    uv = torch.where(in_front[..., None], uv, 0)
    return uv, in_front & ((uv >= 0) & (uv <= 1)).all(-1)


def sample(planes: Float[Tensor, "B C H W"], uv: Float[Tensor, "B P 2"]) -> Float[Tensor, "B P C"]:
    """Bilinear reading of `planes` at `uv`, 0 beyond their edge.

    In the precision of `uv`: bfloat16 could not tell one pixel from the next.
    """
    read = grid_sample(planes.to(uv.dtype), (2 * uv - 1)[:, None], align_corners=False)
    return read[:, :, 0].transpose(1, 2)


@torch.no_grad()
def sight(
    inputs: NetworkInput,
    faces: Int[Tensor, "F 3"],
    vertex_faces: Int[Tensor, "V M"],
    vertex_index: Int[Tensor, "V"] | None,
) -> Sighting:
    """Look at every vertex; `avatar.observation.observe` in batches.

    Args:
        inputs: Photos and posed surfaces.
        faces: Corners.
        vertex_faces: From `anchors.faces_of_vertices`.
        vertex_index: Numbers of the vertices: one on a face that is seen is seen itself. With None visibility is
            equation 4 as printed, without margin or identity.
    """
    vertices, size = inputs.posed, inputs.image.shape[1]
    uv, inside = project_batch(vertices, inputs.viewmat, inputs.K, size)
    visibility = depth_visibility(
        vertices, vertices, faces, inputs.K, inputs.viewmat, size, size, margin=VISIBILITY_MARGIN,
        literal=vertex_index is None, point_vertices=vertex_index, validate=False,
    ).visibility * inside  # fmt: skip
    corners = vertices[:, faces]
    cross = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals = normalize(torch.nn.functional.pad(cross, (0, 0, 0, 1))[:, vertex_faces].sum(2), dim=-1, eps=1e-30)
    center = -inputs.viewmat[:, :3, :3].transpose(1, 2) @ inputs.viewmat[:, :3, 3:]
    facing = (normals * normalize(center.transpose(1, 2) - vertices, dim=-1)).sum(-1)
    trust = ((facing - GRAZING) / (FACING - GRAZING)).clamp(0, 1)
    inner = -max_pool2d(-inputs.mask[:, None], 2 * RIM_PIXELS + 1, stride=1, padding=RIM_PIXELS)
    read = sample(torch.cat([inputs.image.permute(0, 3, 1, 2), inner], dim=1), uv)
    return Sighting(uv, inside, visibility, read[..., :3], visibility * trust * read[..., 3].clamp(0, 1))
