"""Gaussians on a posed mesh."""

import torch
from torch import Tensor

from oasis_warp.core.rotation import multiply, to_matrix
from oasis_warp.reference.face_rotations import plane

EXPONENTS = {"sqrt_area": 0.5, "area": 1.0, "none": 0.0}
LIMIT = 1e4


def pose_on_mesh(
    posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, scale_law,
    vertex_index=None, offsets=None, vertex_area_ratio=None,
):  # fmt: skip
    """Means [N, 3], quats [N, 4] and scales [N, 3], of the Gaussians on vertices and then of those on faces."""
    on_faces = posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio
    if vertex_index is None or offsets is None or vertex_area_ratio is None:  # they come together
        return pose_on_faces(*on_faces, quats, scales, scale_law)
    n = len(vertex_index)
    faced = pose_on_faces(*on_faces, quats[n:], scales[n:], scale_law)
    turn = vertex_quats[vertex_index]
    turn = turn / turn.norm(dim=-1, keepdim=True)
    means = posed_vertices[vertex_index] + (to_matrix(turn) @ offsets[..., None])[..., 0]
    growth = vertex_area_ratio[vertex_index].clamp(1 / LIMIT, LIMIT) ** EXPONENTS[scale_law]
    own = means, multiply(turn, quats[:n]), scales[:n] * growth[:, None]
    return tuple(torch.cat(pair) for pair in zip(own, faced, strict=True))


def pose_on_faces(posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, scale_law):
    """Those on faces alone."""
    corners = faces[face_index]
    means = (barycentrics[..., None] * posed_vertices[corners]).sum(1)
    turns = vertex_quats[corners]
    signs = torch.where(dots_with_leading(turns, barycentrics) < 0, -1.0, 1.0).to(quats)
    mix = (barycentrics[..., None] * signs[..., None] * turns).sum(1)
    growth = area_ratio[face_index].clamp(1 / LIMIT, LIMIT) ** EXPONENTS[scale_law]
    return means, multiply(mix / mix.norm(dim=-1, keepdim=True), quats), scales * growth[:, None]


def dots_with_leading(turns: Tensor, barycentrics: Tensor) -> Tensor:
    """Of the three rotations of each Gaussian with that of its heaviest corner [Q, 3]."""
    heaviest = barycentrics.detach().argmax(-1)[:, None, None].expand(-1, 1, 4)
    return (turns * torch.take_along_dim(turns, heaviest, 1)).sum(-1)


def pose_on_mesh_covars(rest_vertices, posed_vertices, faces, face_index, barycentrics, quats, scales):
    """Means [Q, 3] and covariances [Q, 3, 3] of Gaussians stretched with their faces."""
    ridden = faces[face_index]
    proper = (plane(rest_vertices, ridden).proper & plane(posed_vertices, ridden).proper)[:, None, None]
    identity = torch.eye(3).to(quats)

    def frames(vertices):
        a, b, c = vertices[ridden].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        length = torch.where(proper[:, 0], normal.norm(dim=-1, keepdim=True), 1)
        return torch.where(proper, torch.stack([b - a, c - a, normal / length], -1), identity)

    means = (barycentrics[..., None] * posed_vertices[ridden]).sum(1)
    stretch = frames(posed_vertices) @ torch.linalg.inv(frames(rest_vertices))
    half = stretch @ to_matrix(quats) * scales[:, None]
    return means, half @ half.mT
