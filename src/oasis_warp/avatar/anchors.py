"""Canonical anchors: one flat Gaussian a vertex, one a face, oriented along the surface."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.core import rotation, surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, PosedHand
from oasis_warp.ops.corner_reading import Corners, read_corners

VERTEX_SPREAD = 0.75
"""Standard deviation of a vertex Gaussian over the radius of a disc of the vertex's area: neighbours blend at 60 %."""
FACE_SPREAD = 1.5
"""Standard deviations of a face Gaussian over those of a uniform triangle."""
THICKNESS = 0.5
"""Standard deviation across the surface over the smaller one along it."""
MIN_SCALE = 1e-4
"""Smallest standard deviation [m], for slivers."""
MAX_ANISOTROPY = 3.0
"""Largest over smallest standard deviation along the surface, for slivers."""
OPACITY = 0.95
RIM_FADE = 0.008
"""The last stretch before the open wrist, over which opacity falls to nothing [m]."""
INSET = 0.0008
"""Distance of the surface that carries Gaussians below the skin, in crops of `PRIOR_SIZE` pixels [m]. Blur draws
Gaussians larger than they are: on the skin itself outlines come out a pixel too wide."""
PRIOR_SIZE = 256
"""Side of the crops that the prior reads, and of the pictures that it is trained on [px]."""
MIN_OPACITY = 1 / 255
"""Fainter Gaussians are never drawn, so they are left out."""


class Anchors(NamedTuple):
    """Canonical Gaussians without colour; fields as in `CanonicalGaussians`."""

    vertex_index: Int[Tensor, "P"]
    face_index: Int[Tensor, "Q"]
    barycentrics: Float[Tensor, "Q 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N"]

    def with_colors(self, colors: Float[Tensor, "N 3"]) -> CanonicalGaussians:
        """Complete canonical Gaussians that sit exactly on the surface."""
        offsets = torch.zeros(len(self.vertex_index), 3, dtype=self.scales.dtype, device=self.scales.device)
        return CanonicalGaussians(self.vertex_index, offsets, *self[1:], colors)


class BatchAnchors(NamedTuple):
    """One Gaussian a vertex, then one a face, of B hands."""

    quats: Float[Tensor, "B N 4"]
    scales: Float[Tensor, "B N 3"]
    fade: Float[Tensor, "B N"]
    """As `rim_fade`."""


def inset_offsets(hand: HandModel, size: int = PRIOR_SIZE) -> Float[Tensor, "V 3"]:
    """From the skin at rest to the surface that carries Gaussians in pictures of the hand of `size` pixels [m]."""
    return -INSET * PRIOR_SIZE / size * surface.vertex_normals(hand.template, hand.faces)


def place_anchors(hand: HandModel, rest: PosedHand) -> Anchors:
    """Up to V + F Gaussians on the surface `rest`, vertices first; those that the wrist's fade hides are left out."""
    vertices, faces, rim = rest.vertices, hand.faces.to(rest.vertices.device), hand.rim.to(rest.vertices.device)
    n_vertices = len(vertices)
    every = batch_anchors(vertices[None], faces, surface.faces_of_vertices(faces, n_vertices), rim)
    opacities = OPACITY * every.fade[0]
    kept = opacities >= MIN_OPACITY
    vertex_index, face_index = (torch.nonzero(part)[:, 0] for part in kept.split([n_vertices, len(faces)]))
    return Anchors(
        vertex_index=vertex_index,
        face_index=face_index,
        barycentrics=vertices.new_full((len(face_index), 3), 1 / 3),
        quats=every.quats[0, kept],
        scales=every.scales[0, kept],
        opacities=opacities[kept],
    )


@torch.no_grad()
def batch_anchors(
    rest: Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    vertex_faces: Int[Tensor, "V M"],
    rim: Int[Tensor, "R"],
) -> BatchAnchors:
    """Gaussians on the surfaces `rest`, the faint ones at the wrist included.

    Args:
        rest: Vertices at rest [m].
        faces: Corners.
        vertex_faces: From `core.surface.faces_of_vertices`; makes sums over neighbours gathers, whose order is fixed.
        rim: Vertices of the open wrist.
    """
    vertex_quats, vertex_scales = vertex_shapes(rest, faces, vertex_faces)
    face_quats, face_scales = face_shapes(rest, faces)
    fade = rim_fade(rest, rim)
    return BatchAnchors(
        torch.cat([vertex_quats, face_quats], dim=1),
        torch.cat([vertex_scales, face_scales], dim=1),
        torch.cat([fade, fade[:, faces].mean(2)], dim=1),
    )


def rim_fade(
    rest: Float[Tensor, "B V 3"], rim: Int[Tensor, "R"], start: float = 0.0, length: float = RIM_FADE
) -> Float[Tensor, "B V"]:
    """0 up to `start` [m] from the open wrist, 1 from `length` [m] farther on, smooth between.

    By default the share of its opacity that a vertex's Gaussian may have.
    """
    fade = ((torch.cdist(rest, rest[:, rim]).amin(2) - start) / length).clamp(0, 1)
    return fade * fade * (3 - 2 * fade)


def centers_at_rest(
    gaussians: CanonicalGaussians, rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "N 3"]:
    """Where Gaussians lie on the surface at rest [m]."""
    on_surface = vertex_to_gaussians(rest, faces, gaussians)
    return torch.cat([on_surface[: len(gaussians.offsets)] + gaussians.offsets, on_surface[len(gaussians.offsets) :]])


def vertex_shapes(
    vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"], vertex_faces: Int[Tensor, "V M"]
) -> tuple[Float[Tensor, "*B V 4"], Float[Tensor, "*B V 3"]]:
    """Quaternions and standard deviations [m] of a disc a vertex, as large as its share of the surface."""
    cross = surface.face_crosses(vertices, faces)
    areas = cross.norm(dim=-1, keepdim=True) / 2
    around = surface.gather_to_vertices(torch.cat([cross, areas], dim=-1), vertex_faces)
    normals = normalize(around[..., :3], dim=-1, eps=1e-30)
    spread = VERTEX_SPREAD * (around[..., 3] / 3 / math.pi).sqrt().clamp_min(MIN_SCALE)
    axis = torch.eye(3, dtype=cross.dtype, device=cross.device)[normals.abs().argmin(-1)]
    return surface_frames(normals, axis), torch.stack([spread, spread, THICKNESS * spread], dim=-1)


def face_shapes(
    vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "*B F 4"], Float[Tensor, "*B F 3"]]:
    """Quaternions and standard deviations [m] of a flat Gaussian a face.

    Its axes are those of the triangle as a uniform plate, of covariance (1/12) sum (v - c)(v - c)^T: the eigenvectors
    of a 2 x 2 matrix in the plane of the face.
    """
    corners = vertices[..., faces, :]
    normals = normalize(surface.face_crosses(vertices, faces), dim=-1, eps=1e-30)
    arms = corners - corners.mean(-2, keepdim=True)
    first = normalize(corners[..., 1, :] - corners[..., 0, :], dim=-1, eps=1e-30)
    second = torch.linalg.cross(normals, first)
    x, y = (arms * first[..., None, :]).sum(-1), (arms * second[..., None, :]).sum(-1)
    xx, xy, yy = x.square().sum(-1) / 12, (x * y).sum(-1) / 12, y.square().sum(-1) / 12
    middle, difference = (xx + yy) / 2, (xx - yy) / 2
    radius = torch.hypot(difference, xy)
    angle = torch.atan2(xy, difference) / 2
    along = angle.cos()[..., None] * first + angle.sin()[..., None] * second
    long = (FACE_SPREAD * (middle + radius).sqrt()).clamp_min(MIN_SCALE)
    short = FACE_SPREAD * (middle - radius).clamp_min(0).sqrt()
    short = torch.maximum(short, long / MAX_ANISOTROPY).clamp_min(MIN_SCALE)
    return surface_frames(normals, along), torch.stack([long, short, THICKNESS * short], dim=-1)


def surface_frames(normals: Float[Tensor, "*B N 3"], along: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N 4"]:
    """Quaternions of frames with z along `normals` and x along `along`, made perpendicular to it."""
    x = normalize(along - (along * normals).sum(-1, keepdim=True) * normals, dim=-1)
    return rotation.from_matrix(torch.stack([x, torch.linalg.cross(normals, x), normals], dim=-1))


def vertex_colors(gaussians: CanonicalGaussians, n_vertices: int) -> Float[Tensor, "V 3"]:
    """Those of the vertices' Gaussians; the mean of all where there are none, next to the wrist's end."""
    own = gaussians.colors[: len(gaussians.vertex_index)]
    return own.mean(0).repeat(n_vertices, 1).index_copy(0, gaussians.vertex_index, own)


def gaussian_corners(faces: Int[Tensor, "F 3"], anchors: Anchors | CanonicalGaussians) -> Corners:
    """Vertices and weights with which `vertex_to_gaussians` reads a field at every Gaussian."""
    own = anchors.vertex_index[:, None].expand(-1, 3)
    whole = torch.eye(3, dtype=anchors.barycentrics.dtype, device=own.device)[:1].expand(len(own), 3)
    index = torch.cat([own, faces.index_select(0, anchors.face_index)]).int()
    return Corners(index, torch.cat([whole, anchors.barycentrics]))


def vertex_to_gaussians(
    values: Float[Tensor, "V D"], faces: Int[Tensor, "F 3"], anchors: Anchors | CanonicalGaussians
) -> Float[Tensor, "N D"]:
    """A field over the vertices, read at every Gaussian."""
    return read_corners(values, gaussian_corners(faces, anchors))
