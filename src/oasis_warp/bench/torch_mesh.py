"""Depth buffer, visibility, face rotations and posing as one would write them in torch, without a loop over the mesh.

The peers that the kernels are timed against, and implementations apart from theirs to check them by. Share no code
with the kernels.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.bench.scenes import MeshScene
from oasis_warp.core.rotation import from_matrix, multiply, to_matrix


class Surface(NamedTuple):
    """The nearest surface of each pixel."""

    depth: Float[Tensor, "H W"]
    face_ids: Int[Tensor, "H W"]


def depth_map(scene: MeshScene, near_plane: float = 0.01) -> Surface:
    """`oasis_warp.ops.depth_map` without faces that pass through the near plane.

    A list of every face in every pixel of its box; each pixel keeps the nearest.
    """
    K, width, height = scene.K, scene.width, scene.height
    corners = (scene.posed_vertices @ scene.viewmat[:3, :3].T + scene.viewmat[:3, 3])[scene.faces]
    beyond = (corners[..., 2] > near_plane).all(1).nonzero()[:, 0]
    corners = corners[beyond]
    xy = corners[..., :2] / corners[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    size = torch.tensor([width, height], device=xy.device)
    low = (xy.amin(1) - 0.5).ceil().clamp(min=torch.zeros_like(xy[:, 0]), max=size).long()
    high = ((xy.amax(1) - 0.5).floor() + 1).clamp(min=torch.zeros_like(xy[:, 0]), max=size).long()
    sides = (high - low).clamp_min(0)
    counts = sides.prod(-1)
    which = torch.repeat_interleave(counts)
    place = torch.arange(len(which), device=which.device) - (counts.cumsum(0) - counts)[which]
    x = low[which, 0] + place % sides[which, 0]
    y = low[which, 1] + place // sides[which, 0]
    rays = torch.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    # Edge functions (Olano and Greer 1997): the ray meets the triangle a, b, c at depth det(a, b, c) / sum(w).
    a, b, c = corners.unbind(1)
    cross = torch.linalg.cross
    w = (torch.stack([cross(b, c), cross(c, a), cross(a, b)], 1)[which] * rays[:, None]).sum(-1)
    depth = (a * cross(b, c)).sum(-1)[which] / w.sum(-1)
    hit = ((w >= 0).all(-1) | (w <= 0).all(-1)) & (depth > near_plane)
    pixel, depth, which = (y * width + x)[hit], depth[hit], beyond[which[hit]]
    nearest = torch.full((width * height,), torch.inf, dtype=depth.dtype, device=depth.device)
    nearest = nearest.scatter_reduce(0, pixel, depth, "amin")
    wins = depth == nearest[pixel]
    unseen = len(scene.faces)
    ids = torch.full((width * height,), unseen, device=depth.device)
    ids = ids.scatter_reduce(0, pixel[wins], which[wins], "amin")
    return Surface(nearest.view(height, width), torch.where(ids == unseen, -1, ids).view(height, width))


def depth_visibility(scene: MeshScene, tau: float = 0.0015, near_plane: float = 0.01) -> Float[Tensor, "P"]:
    """`oasis_warp.ops.depth_visibility` of the scene's points with the default margin."""
    surface, K = depth_map(scene, near_plane), scene.K
    at = scene.points @ scene.viewmat[:3, :3].T + scene.viewmat[:3, 3]
    z = torch.where(at[:, 2] > near_plane, at[:, 2], 1)
    column, row = ((at[:, :2] / z[:, None]) * K[[0, 1], [0, 1]] + K[:2, 2]).detach().floor().long().unbind(-1)
    inside = (at[:, 2] > near_plane) & (column >= 0) & (column < scene.width) & (row >= 0) & (row < scene.height)
    depth = surface.depth[row.clamp(0, scene.height - 1), column.clamp(0, scene.width - 1)]
    open_sky = depth.isinf()
    p = torch.sigmoid((torch.where(open_sky, z.detach(), depth) - z + 3 * tau) / tau)
    return torch.where(inside, torch.where(open_sky, 1, p), 0)


class Rotations(NamedTuple):
    """As `oasis_warp.ops.FaceRotations`."""

    vertex_quats: Float[Tensor, "V 4"]
    face_quats: Float[Tensor, "F 4"]
    area_ratio: Float[Tensor, "F"]
    vertex_area_ratio: Float[Tensor, "V"]


def _frames(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Columns t, b, n of each face's frame, its edges in the plane t, b as rows, and its area."""
    a, b, c = vertices[faces].unbind(1)
    e1, e2 = b - a, c - a
    normal = torch.linalg.cross(e1, e2)
    area = normal.norm(dim=-1)
    t, n = normalize(e1, dim=-1, eps=1e-30), normal / area.clamp_min(1e-30)[:, None]
    s = torch.linalg.cross(n, t)
    edges = torch.stack([torch.stack([(e * t).sum(-1), (e * s).sum(-1)], -1) for e in (e1, e2)], 1)
    return torch.stack([t, s, n], -1), edges, area / 2


def face_rotations(scene: MeshScene) -> Rotations:
    """`oasis_warp.ops.face_rotations` of a mesh without flat faces or lonely vertices."""
    rest, posed, faces = scene.rest_vertices, scene.posed_vertices, scene.faces
    frame, edges, area = _frames(rest, faces)
    posed_frame, posed_edges, posed_area = _frames(posed, faces)
    # Polar factor of the map of the edges, P adj(Q) up to a positive factor: its angle has this cosine and sine.
    (length, _), (x, y) = edges[:, 0].unbind(-1), edges[:, 1].unbind(-1)
    (posed_length, _), (posed_x, posed_y) = posed_edges[:, 0].unbind(-1), posed_edges[:, 1].unbind(-1)
    cosine, sine = posed_length * y + length * posed_y, posed_length * x - length * posed_x
    cosine, sine = normalize(torch.stack([cosine, sine], -1), dim=-1, eps=1e-30).unbind(-1)
    zero, one = torch.zeros_like(sine), torch.ones_like(sine)
    turn = torch.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], -1).unflatten(-1, (3, 3))
    face_quats = from_matrix(posed_frame @ turn @ frame.transpose(1, 2))

    # The largest face round each vertex, smallest index first: its quaternion gives the signs.
    weights, n_vertices = area.detach(), len(rest)
    corner_vertex = faces.flatten().long()
    corner_face = torch.arange(len(faces), device=faces.device).repeat_interleave(3)
    largest = weights.new_zeros(n_vertices).scatter_reduce(0, corner_vertex, weights[corner_face], "amax")
    wins = weights[corner_face] == largest[corner_vertex]
    reference = torch.full((n_vertices,), len(faces), device=faces.device)
    reference = reference.scatter_reduce(0, corner_vertex[wins], corner_face[wins], "amin")
    turned = face_quats[corner_face]
    signs = torch.where((turned.detach() * face_quats.detach()[reference[corner_vertex]]).sum(-1) < 0, -1.0, 1.0)
    weighted = (signs.to(area) * area[corner_face])[:, None] * turned
    vertex_quats = normalize(face_quats.new_zeros(n_vertices, 4).index_add(0, corner_vertex, weighted), dim=-1)
    longest = (rest[faces] - rest[faces.roll(1, 1)]).norm(dim=-1).amax(1)
    damping = 0.5e-6 * longest**2
    before, after = area + damping, posed_area + damping
    round_vertices = before.new_zeros(n_vertices, 2)
    round_vertices = round_vertices.index_add(0, corner_vertex, torch.stack([before, after], -1)[corner_face])
    return Rotations(vertex_quats, face_quats, after / before, round_vertices[:, 1] / round_vertices[:, 0])


class Posed(NamedTuple):
    """As `oasis_warp.ops.PosedOnMesh`."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]


def pose_on_mesh(scene: MeshScene) -> Posed:
    """`oasis_warp.ops.pose_on_mesh` with its default scale law."""
    corners, weights = scene.faces[scene.face_index], scene.barycentrics
    turns = scene.vertex_quats[corners]
    leading = torch.take_along_dim(turns, weights.argmax(-1)[:, None, None].expand(-1, 1, 4), 1)
    signs = torch.where((turns * leading).sum(-1) < 0, -1.0, 1.0).to(weights)
    mix = normalize(((weights * signs)[..., None] * turns).sum(1), dim=-1)
    at, turn = scene.posed_vertices[scene.vertex_index], normalize(scene.vertex_quats[scene.vertex_index], dim=-1)
    shifts = (to_matrix(turn) @ scene.offsets[..., None])[..., 0]
    growth = torch.cat([scene.vertex_area_ratio[scene.vertex_index], scene.area_ratio[scene.face_index]])
    return Posed(
        torch.cat([at + shifts, (weights[..., None] * scene.posed_vertices[corners]).sum(1)]),
        multiply(torch.cat([turn, mix]), scene.quats),
        scene.scales * growth.clamp(1e-4, 1e4).sqrt()[:, None],
    )


class Skinned(NamedTuple):
    """As `oasis_warp.ops.Skinned`."""

    means: Float[Tensor, "V 3"]
    covars: Float[Tensor, "V 3 3"]


def skin(scene: MeshScene) -> Skinned:
    """`oasis_warp.ops.skin` of the rest vertices and their covariances."""
    blends = (scene.skin_weights @ scene.transforms.flatten(1)).unflatten(-1, (3, 4))
    turn, shift = blends[..., :3], blends[..., 3]
    return Skinned(
        (turn @ scene.rest_vertices[..., None])[..., 0] + shift, turn @ scene.covars @ turn.transpose(1, 2)
    )


def pose(scene: MeshScene) -> Posed:
    """`pose_on_mesh` by the rotations of `face_rotations`."""
    turned = face_rotations(scene)
    scene = replace(
        scene,
        vertex_quats=turned.vertex_quats,
        area_ratio=turned.area_ratio,
        vertex_area_ratio=turned.vertex_area_ratio,
    )
    return pose_on_mesh(scene)
