"""Gaussians on a posed mesh."""

import torch
from torch import Tensor

from oasis_warp.core.rotation import multiply

EXPONENTS = {"sqrt_area": 0.5, "area": 1.0, "none": 0.0}
LIMIT = 1e4


def pose_on_mesh(posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, scale_law):
    """Means [Q, 3], quats [Q, 4] and scales [Q, 3]."""
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
