"""Gaussians on a posed mesh in plain torch."""

import torch

from oasis_warp.core.rotation import multiply, to_matrix

EXPONENTS = {"sqrt_area": 0.5, "area": 1.0, "none": 0.0}


def pose_on_mesh(posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, scale_law):
    corners = faces[face_index]
    means = (barycentrics[..., None] * posed_vertices[corners]).sum(1)
    turns = vertex_quats[corners]
    leading = torch.take_along_dim(turns, barycentrics.argmax(-1)[:, None, None].expand(-1, 1, 4), 1)
    signs = torch.where((turns * leading).sum(-1) < 0, -1.0, 1.0).to(quats)
    mix = (barycentrics[..., None] * signs[..., None] * turns).sum(1)
    growth = area_ratio[face_index].clamp(1e-4, 1e4) ** EXPONENTS[scale_law]
    return means, multiply(mix / mix.norm(dim=-1, keepdim=True), quats), scales * growth[:, None]


def pose_on_vertices(posed_vertices, vertex_index, offsets, vertex_quats, vertex_area_ratio, quats, scales, scale_law):
    """Gaussians on vertices, as the first ones of `pose_on_mesh`."""
    turn = vertex_quats[vertex_index]
    means = posed_vertices[vertex_index] + (to_matrix(turn) @ offsets[..., None])[..., 0]
    growth = vertex_area_ratio[vertex_index].clamp(1e-4, 1e4) ** EXPONENTS[scale_law]
    return means, multiply(turn / turn.norm(dim=-1, keepdim=True), quats), scales * growth[:, None]


def pose_on_mesh_covars(rest_vertices, posed_vertices, faces, face_index, barycentrics, quats, scales):
    """Covariances stretched with their faces."""

    def frames(vertices):
        a, b, c = vertices[faces[face_index]].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        return torch.stack([b - a, c - a, normal / normal.norm(dim=-1, keepdim=True)], -1)

    means = (barycentrics[..., None] * posed_vertices[faces[face_index]]).sum(1)
    half = frames(posed_vertices) @ torch.linalg.inv(frames(rest_vertices)) @ to_matrix(quats) * scales[:, None]
    return means, half @ half.transpose(1, 2)
