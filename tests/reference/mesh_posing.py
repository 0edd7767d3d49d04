"""Gaussians on a posed mesh in plain torch."""

import torch

from oasis_warp.core.rotation import multiply

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
