"""Face and vertex rotations in plain torch: the polar factor by SVD, vertices one by one."""

import torch

from oasis_warp.core.rotation import from_matrix


def frame(vertices, faces):
    """Edges and unit normal as columns."""
    a, b, c = vertices[faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    return torch.stack([b - a, c - a, normal / normal.norm(dim=-1, keepdim=True)], -1)


def areas(vertices, faces):
    a, b, c = vertices[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2


def longest_edges(vertices, faces):
    a, b, c = vertices[faces].unbind(1)
    return torch.stack([b - a, c - b, a - c]).norm(dim=-1).amax(0)


def face_rotations(rest, posed, faces):
    """Vertex quats, face quats and area ratios of a mesh without flat faces or lonely vertices."""
    u, _, vt = torch.linalg.svd(frame(posed, faces) @ torch.linalg.inv(frame(rest, faces)))
    face_quats = from_matrix(u @ vt)
    weights = areas(rest, faces)
    damping = 0.5e-6 * longest_edges(rest, faces) ** 2
    vertex_quats = []
    for v in range(len(rest)):
        around = (faces == v).any(-1).nonzero()[:, 0]
        reference = face_quats[around[weights[around].argmax()]]
        signs = torch.where(face_quats[around] @ reference < 0, -1.0, 1.0).to(rest)
        mean = (signs[:, None] * weights[around, None] * face_quats[around]).sum(0)
        vertex_quats.append(mean / mean.norm())
    return torch.stack(vertex_quats), face_quats, (areas(posed, faces) + damping) / (weights + damping)
