"""Face and vertex rotations: the polar factor of the 2 x 2 map between edge coordinates, means over a dense table."""

from typing import NamedTuple

import torch
from torch import Tensor

from oasis_warp.core.rotation import from_matrix

FLAT = 1e-6
"""Twice the area over the longest edge squared, up to which a face counts as flat."""
DAMPING = 0.5e-6
"""Added to both areas of a ratio, as a share of the longest rest edge squared."""


class Plane(NamedTuple):
    """Triangles in their own planes; those that are not `proper` are replaced by a unit one."""

    axes: Tensor
    """Unit columns: along the first edge, across it, normal [F, 3, 3]."""
    edges: Tensor
    """Columns: both edges in the first two axes [F, 2, 2]."""
    area: Tensor
    longest: Tensor
    flatness: Tensor
    """Twice the area over the longest edge squared."""
    proper: Tensor


def plane(vertices: Tensor, faces: Tensor) -> Plane:
    """Every face of a mesh, in its plane."""
    a, b, c = vertices[faces].unbind(1)
    first, second = b - a, c - a
    longest = torch.stack([first, second, c - b]).norm(dim=-1).amax(0)
    normal = torch.linalg.cross(first, second)
    doubled = normal.norm(dim=-1)
    flatness = torch.where(longest > 0, doubled / longest.clamp(min=1e-150) ** 2, 0).detach()
    proper = flatness > FLAT
    unit = torch.eye(3).to(vertices)
    first = torch.where(proper[:, None], first, unit[0])
    second = torch.where(proper[:, None], second, unit[1])
    n = torch.where(proper[:, None], normal / torch.where(proper, doubled, 1)[:, None], unit[2])
    t = first / first.norm(dim=-1, keepdim=True)
    s = torch.linalg.cross(n, t)
    edges = torch.stack([torch.stack([(e * axis).sum(-1) for axis in (t, s)], -1) for e in (first, second)], -1)
    area = torch.where(proper, doubled, doubled.detach()) / 2  # a flat face has no normal to grow along
    return Plane(torch.stack([t, s, n], -1), edges, area, longest, flatness, proper)


def face_rotations(rest: Tensor, posed: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Vertex quats, face quats and area ratios."""
    return turned(rest, posed, faces)[:3]


def turned(rest: Tensor, posed: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """As `face_rotations`, area ratios of vertices, and for which vertices [V] no sign hangs on rounding."""
    before, after = plane(rest, faces), plane(posed, faces)
    proper = before.proper & after.proper
    (p, q), (r, s) = before.edges.unbind(1)[0].unbind(-1), before.edges.unbind(1)[1].unbind(-1)
    adjugate = torch.stack([torch.stack([s, -q], -1), torch.stack([-r, p], -1)], 1)
    m = after.edges @ adjugate  # the map of the edges times a positive number
    cos, sin = m[:, 0, 0] + m[:, 1, 1], m[:, 1, 0] - m[:, 0, 1]
    length = torch.hypot(cos, sin)
    cos, sin, zero, one = cos / length, sin / length, torch.zeros_like(cos), torch.ones_like(cos)
    turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], -1).view(-1, 3, 3)
    face_quats = from_matrix(after.axes @ turn @ before.axes.transpose(1, 2))

    weights = torch.where(proper, before.area, 0)
    identity = torch.eye(4)[0].to(rest)
    largest = weights.detach().argmax() if len(faces) else None
    usual = face_quats[largest].detach() if largest is not None and weights[largest] > 0 else identity
    face_quats = torch.where(proper[:, None], face_quats, usual)

    touches = torch.zeros(len(rest), len(faces)).to(rest)
    touches[faces.T, torch.arange(len(faces))] = 1.0
    around = touches * weights
    if len(faces) == 0:
        lonely = torch.ones(len(rest), dtype=torch.bool)
        return identity.expand(len(rest), 4), face_quats, before.area, torch.ones(len(rest)).to(rest), lonely
    reference = around.detach().argmax(1)
    dots = (face_quats[reference] @ face_quats.T).detach()
    total = (around * torch.where(dots < 0, -1.0, 1.0)) @ face_quats
    usable = around.detach().sum(1) > 0
    norm = torch.where(usable[:, None], total, 1).norm(dim=-1, keepdim=True)
    vertex_quats = torch.where(usable[:, None], total / norm, usual)

    damping = DAMPING * before.longest**2
    a_point = before.longest == 0
    ratio = (after.area + damping) / torch.where(a_point, 1, before.area + damping)
    ratio = torch.where(a_point, 1, ratio)
    corners = torch.zeros(len(rest), len(faces)).to(rest)
    for corner in faces.T:
        corners[corner, torch.arange(len(faces))] += 1.0
    rest_sum, posed_sum = corners @ (before.area + damping), corners @ (after.area + damping)
    alone = rest_sum == 0
    vertex_ratio = torch.where(alone, 1, posed_sum / torch.where(alone, 1, rest_sum))
    right_angle = (dots.abs() < 1e-4) & (around > 0)
    return vertex_quats, face_quats, ratio, vertex_ratio, ~right_angle.any(1)
