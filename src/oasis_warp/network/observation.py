"""How well each photo of a batch shows each vertex: visibility, and colours that can be trusted."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from oasis_warp.avatar.observation import FACING, GRAZING, RIM_PIXELS, VISIBILITY_MARGIN
from oasis_warp.network.inputs import NetworkInput
from oasis_warp.network.projection import project_batch, sample
from oasis_warp.ops import depth_visibility


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
