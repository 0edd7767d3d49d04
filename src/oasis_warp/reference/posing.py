"""Rotations of faces and vertices, Gaussians on a posed mesh, and linear blend skinning."""

from typing import NamedTuple

import torch
from torch import Tensor

from oasis_warp.core.rotation import from_matrix, multiply, to_matrix

FLAT = 1e-6
"""Twice the area over the longest edge squared, up to which a face counts as flat."""
DAMPING = 0.5e-6
"""Added to both areas of a ratio, as a share of the longest rest edge squared."""
RIGHT_ANGLE = 1e-4
"""Dot product of two quaternions below which rounding may decide the sign of one."""
EXPONENTS = {"sqrt_area": 0.5, "area": 1.0, "none": 0.0}
"""Exponent of the area ratio, by scale law."""
LIMIT = 1e4
"""Area ratios are clamped to this and its inverse before they act on scales."""


class Planes(NamedTuple):
    """Triangles in their own planes; those that are not `proper` are replaced by a unit triangle."""

    axes: Tensor
    """Unit columns: along the first edge, across it, normal [F, 3, 3]."""
    edges: Tensor
    """Columns: both edges in the first two axes [F, 2, 2]."""
    area: Tensor
    longest: Tensor
    """Edge."""
    proper: Tensor
    """Whether the face is not flat."""


class Rotations(NamedTuple):
    """As `oasis_warp.ops.FaceRotations`, and which vertex quaternions do not depend on rounding."""

    vertex_quats: Tensor
    face_quats: Tensor
    area_ratio: Tensor
    vertex_area_ratio: Tensor
    sound: Tensor
    """[V]"""


def planes(vertices: Tensor, faces: Tensor) -> Planes:
    """Every face of a mesh, in its plane."""
    a, b, c = vertices[faces].unbind(1)
    first, second = b - a, c - a
    longest = torch.stack([first, second, c - b]).norm(dim=-1).amax(0)
    normal = torch.linalg.cross(first, second)
    doubled = normal.norm(dim=-1)
    flatness = doubled / torch.where(longest > 0, longest, 1) ** 2
    proper = (flatness > FLAT) & (longest > 0)
    unit = torch.eye(3).to(vertices)
    first = torch.where(proper[:, None], first, unit[0])
    second = torch.where(proper[:, None], second, unit[1])
    n = torch.where(proper[:, None], normal / torch.where(proper, doubled, 1)[:, None], unit[2])
    t = first / first.norm(dim=-1, keepdim=True)
    s = torch.linalg.cross(n, t)
    edges = torch.stack([torch.stack([(e * axis).sum(-1) for axis in (t, s)], -1) for e in (first, second)], -1)
    area = torch.where(proper, doubled, doubled.detach()) / 2  # a flat face has no normal to grow along
    return Planes(torch.stack([t, s, n], -1), edges, area, longest, proper)


def polar_rotations(rest: Planes, posed: Planes) -> Tensor:
    """Quaternions [F, 4] of the polar factors of the 2 x 2 maps between the edges."""
    (p, q), (r, s) = rest.edges.unbind(1)[0].unbind(-1), rest.edges.unbind(1)[1].unbind(-1)
    adjugate = torch.stack([torch.stack([s, -q], -1), torch.stack([-r, p], -1)], 1)
    m = posed.edges @ adjugate  # the map of the edges times a positive number
    cos, sin = m[:, 0, 0] + m[:, 1, 1], m[:, 1, 0] - m[:, 0, 1]
    length = torch.hypot(cos, sin)
    cos, sin, zero, one = cos / length, sin / length, torch.zeros_like(cos), torch.ones_like(cos)
    in_plane = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], -1).view(-1, 3, 3)
    return from_matrix(posed.axes @ in_plane @ rest.axes.transpose(1, 2))


def face_rotations(rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor) -> Rotations:
    """As `oasis_warp.ops.face_rotations`."""
    rest, posed = planes(rest_vertices, faces), planes(posed_vertices, faces)
    proper, n_vertices = rest.proper & posed.proper, len(rest_vertices)
    identity = torch.eye(4)[0].to(rest_vertices)
    if len(faces) == 0:
        ones = torch.ones(n_vertices).to(rest_vertices)
        return Rotations(identity.expand(n_vertices, 4), identity.expand(0, 4), rest.area, ones, ones > 0)
    face_quats = polar_rotations(rest, posed)
    weights = torch.where(proper, rest.area, 0)
    largest = weights.detach().argmax()
    usual = torch.where(weights[largest] > 0, face_quats[largest], identity).detach()
    face_quats = torch.where(proper[:, None], face_quats, usual)

    vertex = faces.flatten().long()
    face = torch.arange(len(faces), device=faces.device).repeat_interleave(3)
    corner_weights = weights[face]
    # The largest face at each vertex, of equal ones the first, decides the signs.
    most = weights.detach().new_zeros(n_vertices).scatter_reduce(0, vertex, corner_weights.detach(), "amax")
    wins = corner_weights.detach() == most[vertex]
    reference = torch.full((n_vertices,), len(faces) - 1, device=faces.device)
    reference = reference.scatter_reduce(0, vertex[wins], face[wins], "amin")
    dots = (face_quats[face] * face_quats[reference[vertex]]).sum(-1).detach()
    signed = (torch.where(dots < 0, -corner_weights, corner_weights))[:, None] * face_quats[face]
    total = torch.zeros(n_vertices, 4).to(rest_vertices).index_add(0, vertex, signed)
    usable = (most > 0)[:, None]
    vertex_quats = torch.where(usable, total / torch.where(usable, total, 1).norm(dim=-1, keepdim=True), usual)
    unsure = ((dots.abs() < RIGHT_ANGLE) & (corner_weights > 0)).long()
    sound = torch.zeros_like(reference).index_add(0, vertex, unsure) == 0

    damping = DAMPING * rest.longest**2
    before, after = rest.area + damping, posed.area + damping
    a_point = rest.longest == 0
    ratio = torch.where(a_point, 1, after / torch.where(a_point, 1, before))
    sums = torch.zeros(n_vertices, 2).to(rest_vertices).index_add(0, vertex, torch.stack([before, after], -1)[face])
    alone = sums[:, 0] == 0
    vertex_ratio = torch.where(alone, 1, sums[:, 1] / torch.where(alone, 1, sums[:, 0]))
    return Rotations(vertex_quats, face_quats, ratio, vertex_ratio, sound)


def pose_on_mesh(
    posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, scale_law="sqrt_area",
    vertex_index=None, offsets=None, vertex_area_ratio=None,
):  # fmt: skip
    """As `oasis_warp.ops.pose_on_mesh`: means, quats, scales of the Gaussians on vertices, then of those on faces."""
    corners = faces[face_index]
    means = (barycentrics[..., None] * posed_vertices[corners]).sum(1)
    corner_quats = vertex_quats[corners]
    signs = torch.where(dots_with_heaviest(corner_quats, barycentrics) < 0, -1.0, 1.0).to(quats)
    mix = (barycentrics[..., None] * signs[..., None] * corner_quats).sum(1)
    mix, growth = mix / mix.norm(dim=-1, keepdim=True), area_ratio[face_index]
    if vertex_index is not None:
        assert offsets is not None and vertex_area_ratio is not None  # the three come together
        own = vertex_quats[vertex_index] / vertex_quats[vertex_index].norm(dim=-1, keepdim=True)
        shifted = posed_vertices[vertex_index] + (to_matrix(own) @ offsets[..., None])[..., 0]
        means, mix = torch.cat([shifted, means]), torch.cat([own, mix])
        growth = torch.cat([vertex_area_ratio[vertex_index], growth])
    growth = growth.clamp(1 / LIMIT, LIMIT) ** EXPONENTS[scale_law]
    return means, multiply(mix, quats), scales * growth[:, None]


def dots_with_heaviest(corner_quats: Tensor, barycentrics: Tensor) -> Tensor:
    """Dot products [Q, 3] of the three rotations of each Gaussian with that of its heaviest corner."""
    heaviest = barycentrics.detach().argmax(-1)[:, None, None].expand(-1, 1, 4)
    return (corner_quats * torch.take_along_dim(corner_quats, heaviest, 1)).sum(-1)


def pose_on_mesh_covars(rest_vertices, posed_vertices, faces, face_index, barycentrics, quats, scales):
    """As `oasis_warp.ops.pose_on_mesh_covars`: means [Q, 3] and covariances [Q, 3, 3]."""
    triangles = faces[face_index]
    proper = (planes(rest_vertices, triangles).proper & planes(posed_vertices, triangles).proper)[:, None, None]
    identity = torch.eye(3).to(quats)

    def frames(vertices: Tensor) -> Tensor:
        a, b, c = vertices[triangles].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        length = torch.where(proper[:, 0], normal.norm(dim=-1, keepdim=True), 1)
        return torch.where(proper, torch.stack([b - a, c - a, normal / length], -1), identity)

    means = (barycentrics[..., None] * posed_vertices[triangles]).sum(1)
    stretch = frames(posed_vertices) @ torch.linalg.inv(frames(rest_vertices))
    half = stretch @ to_matrix(quats) * scales[:, None]
    return means, half @ half.mT


def skin(means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, rotation_only: bool = False):
    """As `oasis_warp.ops.skin`: means [N, 3] and, where given, covariances [N, 3, 3]; matrices are blended first."""
    blends = (weights @ transforms[:, :3].flatten(1)).unflatten(1, (3, 4))
    linear, shift = blends[..., :3], blends[..., 3]
    moved = (linear @ means[..., None])[..., 0] + shift
    if covars is None:
        return (moved,)
    linear = nearest_rotations(linear) if rotation_only else linear
    return moved, linear @ covars @ linear.transpose(1, 2)


def nearest_rotations(matrices: Tensor) -> Tensor:
    """Proper rotations nearest to matrices: R exp(hat(omega)) to first order round the R of an SVD.

    The adjoint of the SVD itself divides by differences of singular values, which are equal for a rotation. Here
    (tr(P) - P) omega = vee(R^T M - M^T R), P = R^T M the stretch, and only sums of two singular values are divided by.
    """
    u, _, vt = torch.linalg.svd(matrices.detach())
    last = torch.ones(len(matrices), 3).to(matrices)
    last[:, 2] = torch.linalg.det(u @ vt)
    rotation = u * last[:, None, :] @ vt
    moved = rotation.mT @ matrices
    stretch = moved.detach()
    trace = stretch.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
    skewed = moved - moved.mT
    vee = torch.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], -1)
    omega = torch.linalg.solve(trace * torch.eye(3).to(matrices) - stretch, vee)
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    hat = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
    return rotation + rotation @ hat
