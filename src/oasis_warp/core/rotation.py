"""Rotations in torch: wxyz quaternions and matrices."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def multiply(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product: first rotates by `b`, then by `a`."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def to_matrix(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any positive norm."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def from_matrix(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions with w >= 0 of rotation matrices; the largest component is found first (Shepperd 1978)."""
    m = matrices
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0],
                         m[..., 1, 0] - m[..., 0, 1]], -1),
            torch.stack([m[..., 2, 1] - m[..., 1, 2], 1 + m00 - m11 - m22, m[..., 0, 1] + m[..., 1, 0],
                         m[..., 0, 2] + m[..., 2, 0]], -1),
            torch.stack([m[..., 0, 2] - m[..., 2, 0], m[..., 0, 1] + m[..., 1, 0], 1 - m00 + m11 - m22,
                         m[..., 1, 2] + m[..., 2, 1]], -1),
            torch.stack([m[..., 1, 0] - m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1],
                         1 - m00 - m11 + m22], -1),
        ],
        dim=-2,
    )  # fmt: skip
    best = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(candidates, best[..., None, None].expand(*best.shape, 1, 4), -2).squeeze(-2)
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def rotate(quats: Float[Tensor, "*batch 4"], vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Vectors rotated by unit quaternions."""
    axes = quats[..., 1:]
    twice = 2 * torch.linalg.cross(axes, vectors)
    return vectors + quats[..., :1] * twice + torch.linalg.cross(axes, twice)


def from_axis_angle(axes: Float[Tensor, "*batch 3"], angles: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices about unit `axes` by `angles` [rad] (Rodrigues)."""
    x, y, z = axes.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    sin, cos = torch.sin(angles)[..., None, None], torch.cos(angles)[..., None, None]
    eye = torch.eye(3, dtype=axes.dtype, device=axes.device)
    return eye + sin * cross + (1 - cos) * (cross @ cross)


def euler_rotations(angles: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotations by the third angle about z, then the second about y, then the first about x [rad]."""
    (ca, cb, cc), (sa, sb, sc) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = [
        cb * cc, -cb * sc, sb,
        ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb,
        sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb,
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def euler_angles(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The angles of `euler_rotations`, the second within a quarter turn [rad]."""
    m = matrices
    first = torch.atan2(-m[..., 1, 2], m[..., 2, 2])
    second = torch.atan2(m[..., 0, 2], torch.hypot(m[..., 0, 0], m[..., 0, 1]))
    third = torch.atan2(-m[..., 0, 1], m[..., 0, 0])
    return torch.stack([first, second, third], -1)


def from_vector(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axes times angles [rad]."""
    angles = vectors.norm(dim=-1)
    return from_axis_angle(vectors / angles.clamp_min(1e-12)[..., None], angles)


def to_vector(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis times angle [rad] of rotation matrices."""
    quats = from_matrix(matrices)
    half = quats[..., 1:].norm(dim=-1, keepdim=True)
    return quats[..., 1:] * torch.where(half > 1e-6, 2 * torch.atan2(half, quats[..., :1]) / half.clamp_min(1e-6), 2.0)


def is_rotation(matrix: Float[Tensor, "3 3"], tolerance: float = 1e-3) -> Bool[Tensor, ""]:
    """Whether a finite matrix is a rotation: orthonormal rows, determinant 1."""
    off = (matrix @ matrix.T - torch.eye(3).to(matrix)).abs().amax()
    return (off < tolerance) & (torch.linalg.det(matrix) > 0)
