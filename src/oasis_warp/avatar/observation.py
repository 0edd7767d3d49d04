"""What photos show at the vertices of the posed surface: their colours, and how far to trust them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from oasis_warp.core import surface
from oasis_warp.core.camera import camera_center
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandCrop, TrainingBatch
from oasis_warp.core.windows import largest_around, mean_around
from oasis_warp.ops import depth_visibility

RIM_PIXELS = 2
"""Pixels inside the mask's border that may hold some background."""
VISIBILITY_MARGIN = 0.0015
"""Depth by which a vertex may lie behind the depth buffer and still be seen [m]. Vertices are visible by identity, so
that a third of the usual margin is enough; finger tips are thinner than the usual one."""
GRAZING, FACING = 0.15, 0.45
"""Cosines between the normal and the view below which a point says nothing and above which it is fully trusted."""
NEAR = 0.01
"""Depth up to which a point counts as behind the camera [m]."""


class CropBatch(NamedTuple):
    """B square crops with the surfaces fitted to them; fields as in `TrainingBatch`."""

    image: Float[Tensor, "B S S 3"]
    mask: Float[Tensor, "B S S"]
    posed: Float[Tensor, "B V 3"]
    viewmat: Float[Tensor, "B 4 4"]
    K: Float[Tensor, "B 3 3"]
    rest: Float[Tensor, "B V 3"]


class Observation(NamedTuple):
    """The vertices of a posed surface in its photo; of B photos all fields have an axis B in front."""

    uv: Float[Tensor, "*B V 2"]
    """Projections; the image's corners at 0 and 1."""
    inside: Bool[Tensor, "*B V"]
    """Whether they fall into the image, in front of the camera."""
    visibility: Float[Tensor, "*B V"]
    """Equation 4; 0 where not inside."""
    facing: Float[Tensor, "*B V"]
    """Cosine between each vertex's normal and its direction to the camera: negative where it turns away."""
    colors: Float[Tensor, "*B V 3"]
    """Read off the photo."""
    confidence: Float[Tensor, "*B V"]
    """0 unseen, 1 seen well: visible, facing the camera and clear of the mask's border."""


def batch_of_crop(crop: HandCrop) -> CropBatch:
    """One crop as a batch of one."""
    camera = crop.camera
    parts = crop.image, crop.mask, crop.posed.vertices, camera.viewmat, camera.K, crop.rest.vertices
    return CropBatch(*(part.to(crop.image)[None] for part in parts))


def source_photos(batch: TrainingBatch) -> CropBatch:
    """The photos of a training batch, without its targets."""
    return CropBatch(*batch[: len(CropBatch._fields)])


def observe(hand: HandModel, crop: HandCrop) -> Observation:
    """`observe_batch` of one crop."""
    batch, faces = batch_of_crop(crop), hand.faces.to(crop.image.device)
    n_vertices = len(crop.posed.vertices)
    everything = torch.arange(n_vertices, device=faces.device)
    seen = observe_batch(batch, faces, surface.faces_of_vertices(faces, n_vertices), everything)
    return Observation(*(part[0] for part in seen))


@torch.no_grad()
def observe_batch(
    crops: CropBatch,
    faces: Int[Tensor, "F 3"],
    vertex_faces: Int[Tensor, "V M"],
    vertex_index: Int[Tensor, "V"] | None,
) -> Observation:
    """Read each photo at every vertex, by projection and the depth buffer of the posed surface.

    Args:
        crops: Photos and posed surfaces.
        faces: Corners.
        vertex_faces: From `core.surface.faces_of_vertices`.
        vertex_index: Numbers of the vertices: one on a face that is seen is seen itself. With None visibility is
            equation 4 as printed, without margin or identity.
    """
    vertices, size = crops.posed, crops.image.shape[1]
    uv, inside = project_batch(vertices, crops.viewmat, crops.K, size)
    visibility = depth_visibility(
        vertices, vertices, faces, crops.K, crops.viewmat, size, size, margin=VISIBILITY_MARGIN,
        literal=vertex_index is None, point_vertices=vertex_index, validate=False,
    ).visibility * inside  # fmt: skip
    inner = inner_mask(crops.mask)[:, None]
    read = sample(torch.cat([crops.image.permute(0, 3, 1, 2), inner], dim=1), uv)
    cosine = facing(vertices, surface.gathered_normals(vertices, faces, vertex_faces), crops.viewmat)
    trust = ((cosine - GRAZING) / (FACING - GRAZING)).clamp(0, 1)
    confidence = visibility * trust * read[..., 3].clamp(0, 1)
    return Observation(uv, inside, visibility, cosine, read[..., :3], confidence)


def facing(
    vertices: Float[Tensor, "*B V 3"], normals: Float[Tensor, "*B V 3"], viewmat: Float[Tensor, "*B 4 4"]
) -> Float[Tensor, "*B V"]:
    """Cosine between each vertex's normal and its direction to the camera: negative where it turns away."""
    return (normals * normalize(camera_center(viewmat)[..., None, :] - vertices, dim=-1)).sum(-1)


def inner_mask(mask: Float[Tensor, "*B H W"], pixels: int = RIM_PIXELS) -> Float[Tensor, "*B H W"]:
    """The mask without its outermost `pixels`."""
    return -largest_around(-mask, pixels)


def faded_in(mask: Float[Tensor, "S S"], border: float) -> Float[Tensor, "S S"]:
    """Share of each pixel that is surely hand; it grows from the mask's border over a width of `border` sides."""
    rim = max(1, round(border * len(mask)))
    inner = inner_mask(mask, 2 * rim)
    return mean_around(inner, rim)


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
