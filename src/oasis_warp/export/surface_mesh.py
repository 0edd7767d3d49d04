"""The avatar's surface as a mesh with texture coordinates, its wrist closed by a cap."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.wrist import CAP_HEIGHT
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.surface import vertex_normals
from oasis_warp.hand_avatar import Avatar

CAP_CORNER = (0.0125, 0.9875)
"""Texture coordinates of the cap: a corner where the hand has no skin."""


class Topology(NamedTuple):
    """Vertices of the mesh, as vertices of the hand: U with a texture coordinate each, R of the rim, one of the cap."""

    vertex: Int[Tensor, "U+R"]
    """Of the hand; the last vertex of the mesh is the mean of those of the rim."""
    rim: Int[Tensor, "R"]
    uv: Float[Tensor, "U+R+1 2"]
    """v points up in the picture."""
    faces: Int[Tensor, "F 3"]
    """Counter-clockwise seen from outside."""


def topology(avatar: Avatar) -> Topology:
    """How the mesh of this side of hand is connected."""
    hand = avatar.hand
    pairs, corner = torch.unique(
        torch.stack([hand.faces.flatten(), hand.uv_faces.flatten()], 1), dim=0, return_inverse=True
    )
    n_skin, n_rim = len(pairs), len(hand.rim)
    ring = n_skin + torch.arange(n_rim)
    cap = torch.stack([ring, ring.roll(-1), torch.full_like(ring, n_skin + n_rim)], 1)
    edge = hand.template[hand.rim]
    center, outwards = rim_cap_center(hand, hand.template)
    turning = torch.linalg.cross(edge.roll(-1, 0) - edge, center - edge).sum(0)
    if float(turning @ outwards) < 0:
        cap = cap.flip(1)
    faces = torch.cat([corner.unflatten(0, (-1, 3)), cap])
    corner_uv = torch.tensor(CAP_CORNER).expand(n_rim + 1, 2)
    return Topology(
        torch.cat([pairs[:, 0], hand.rim]), hand.rim, torch.cat([hand.uv[pairs[:, 1]], corner_uv]),
        faces.flip(1) if avatar.side == "left" else faces,
    )  # fmt: skip


def rim_cap_center(hand: HandModel, vertices: Float[Tensor, "V 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """The middle of the cap over the wrist [m], and the direction in which it points."""
    edge = vertices[hand.rim]
    center = edge.mean(0)
    axis = normalize(torch.linalg.cross(edge - center, (edge - center).roll(-1, 0)).sum(0), dim=0)
    axis = axis * torch.sign(axis @ (center - vertices.mean(0)))
    return center + CAP_HEIGHT * axis, axis


def at_mesh(values: Float[Tensor, "V *D"], mesh: Topology) -> Float[Tensor, "W *D"]:
    """Values of the hand's vertices at those of the mesh."""
    return torch.cat([values[mesh.vertex], values[mesh.rim].mean(0, keepdim=True)])


def mesh_points(vertices: Float[Tensor, "V 3"], hand: HandModel, mesh: Topology) -> Float[Tensor, "W 3"]:
    """Vertices of the mesh where the hand's are `vertices` [m]."""
    points = at_mesh(vertices, mesh)
    points[-1] = rim_cap_center(hand, vertices)[0]
    return points


def mesh_normals(points: Float[Tensor, "W 3"], mesh: Topology) -> Float[Tensor, "W 3"]:
    """Unit normals, smooth across the seams of the texture and sharp at the edge of the cap."""
    n_skin = len(mesh.vertex) - len(mesh.rim)
    owner = torch.cat([mesh.vertex[:n_skin], int(mesh.vertex.max()) + 1 + torch.arange(len(mesh.rim) + 1)])
    welded = points.new_zeros(int(owner.max()) + 1, 3)
    welded[owner] = points
    return vertex_normals(welded, owner[mesh.faces])[owner]
