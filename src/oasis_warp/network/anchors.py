"""Where the Gaussians of many hands sit, and how large they are, before the network: `avatar.anchors` in batches."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import (
    FACE_SPREAD,
    MAX_ANISOTROPY,
    MIN_SCALE,
    RIM_FADE,
    THICKNESS,
    VERTEX_SPREAD,
    surface_frames,
)


class BatchAnchors(NamedTuple):
    """One Gaussian a vertex, then one a face, of B hands."""

    quats: Float[Tensor, "B N 4"]
    scales: Float[Tensor, "B N 3"]
    fade: Float[Tensor, "B N"]
    """As `rim_fade`."""


def faces_of_vertices(faces: Int[Tensor, "F 3"], n_vertices: int) -> Int[Tensor, "V M"]:
    """The faces round each vertex, ascending; rows are filled up with F, one past the last face."""
    order = faces.flatten().argsort(stable=True)
    owner, face = faces.flatten()[order], order // 3
    count = torch.bincount(owner, minlength=n_vertices)
    place = torch.arange(len(owner), device=faces.device) - (count.cumsum(0) - count)[owner]
    table = torch.full((n_vertices, int(count.max())), len(faces), dtype=torch.int64, device=faces.device)
    table[owner, place] = face
    return table


def rim_fade(rest: Float[Tensor, "B V 3"], rim: Int[Tensor, "R"]) -> Float[Tensor, "B V"]:
    """0 at the open wrist, 1 from `RIM_FADE` on: the share of its opacity that a vertex's Gaussian may have."""
    fade = (torch.cdist(rest, rest[:, rim]).amin(2) / RIM_FADE).clamp(0, 1)
    return fade * fade * (3 - 2 * fade)


@torch.no_grad()
def batch_anchors(
    rest: Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    vertex_faces: Int[Tensor, "V M"],
    rim: Int[Tensor, "R"],
) -> BatchAnchors:
    """Gaussians on the surfaces `rest`, with the shapes and opacities of `avatar.anchors.place_anchors`.

    Args:
        rest: Vertices at rest [m].
        faces: Corners.
        vertex_faces: From `faces_of_vertices`; it makes sums over neighbours gathers, whose order is fixed.
        rim: Vertices of the open wrist.
    """
    corners = rest[:, faces]
    cross = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals = normalize(cross, dim=-1, eps=1e-30)
    vertex_quats, vertex_scales = _vertex_shapes(cross, vertex_faces)
    face_quats, face_scales = _face_shapes(corners, normals)
    fade = rim_fade(rest, rim)
    return BatchAnchors(
        torch.cat([vertex_quats, face_quats], dim=1),
        torch.cat([vertex_scales, face_scales], dim=1),
        torch.cat([fade, fade[:, faces].mean(2)], dim=1),
    )


def _vertex_shapes(cross: Tensor, vertex_faces: Tensor) -> tuple[Tensor, Tensor]:
    areas = cross.norm(dim=-1, keepdim=True) / 2
    values = torch.nn.functional.pad(torch.cat([cross, areas], dim=-1), (0, 0, 0, 1))  # a zero row past the last face
    around = values[:, vertex_faces].sum(2)
    normals = normalize(around[..., :3], dim=-1, eps=1e-30)
    spread = VERTEX_SPREAD * (around[..., 3] / 3 / math.pi).sqrt().clamp_min(MIN_SCALE)
    axis = torch.eye(3, dtype=cross.dtype, device=cross.device)[normals.abs().argmin(-1)]
    quats = surface_frames(normals.flatten(0, 1), axis.flatten(0, 1)).unflatten(0, normals.shape[:2])
    return quats, torch.stack([spread, spread, THICKNESS * spread], dim=-1)


def _face_shapes(corners: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Principal axes of each triangle as a uniform plate, by the eigenvectors of its 2 x 2 covariance."""
    arms = corners - corners.mean(2, keepdim=True)
    first = normalize(corners[:, :, 1] - corners[:, :, 0], dim=-1, eps=1e-30)
    second = torch.linalg.cross(normals, first)
    x, y = (arms * first[:, :, None]).sum(-1), (arms * second[:, :, None]).sum(-1)
    xx, xy, yy = x.square().sum(2) / 12, (x * y).sum(2) / 12, y.square().sum(2) / 12
    middle, difference = (xx + yy) / 2, (xx - yy) / 2
    radius = torch.hypot(difference, xy)
    angle = torch.atan2(xy, difference) / 2
    along = angle.cos()[..., None] * first + angle.sin()[..., None] * second
    long = (FACE_SPREAD * (middle + radius).sqrt()).clamp_min(MIN_SCALE)
    short = FACE_SPREAD * (middle - radius).clamp_min(0).sqrt()
    short = torch.maximum(short, long / MAX_ANISOTROPY).clamp_min(MIN_SCALE)
    quats = surface_frames(normals.flatten(0, 1), along.flatten(0, 1)).unflatten(0, normals.shape[:2])
    return quats, torch.stack([long, short, THICKNESS * short], dim=-1)
