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
