"""Linear blend skinning, with matrices blended first."""

import torch
from torch import Tensor


def skin(means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, rotation_only: bool = False):
    """Means [N, 3] and, where given, covariances [N, 3, 3]."""
    blends = (weights @ transforms[:, :3].flatten(1)).unflatten(1, (3, 4))
    linear, shift = blends[..., :3], blends[..., 3]
    moved = (linear @ means[..., None])[..., 0] + shift
    if covars is None:
        return (moved,)
    turn = nearest_rotations(linear) if rotation_only else linear
    return moved, turn @ covars @ turn.transpose(1, 2)


def nearest_rotations(matrices: Tensor) -> Tensor:
    """Proper rotations nearest to matrices with three different singular values."""
    u, _, vt = torch.linalg.svd(matrices)
    sign = torch.linalg.det(u @ vt).detach().sign()
    last = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1)
    return u * last[:, None, :] @ vt


def spread(matrices: Tensor) -> Tensor:
    """How far each nearest rotation is from not being unique: the smallest denominator of its derivative [N]."""
    s = torch.linalg.svdvals(matrices.detach())
    smallest = s[:, 2] * torch.linalg.det(matrices.detach()).sign()
    return (s[:, 1] + smallest) / s[:, 0].clamp(min=1e-300)
