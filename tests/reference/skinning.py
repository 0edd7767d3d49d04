"""Linear blend skinning in plain torch; the nearest rotation by SVD."""

import torch


def skin(means, covars, weights, transforms, rotation_only=False):
    """Skinned means, and covariances where given."""
    blends = torch.einsum("nj,jrc->nrc", weights, transforms[:, :3])
    linear = blends[:, :, :3]
    moved = torch.einsum("nrc,nc->nr", linear, means) + blends[:, :, 3]
    if covars is None:
        return moved, None
    if rotation_only:
        u, _, vt = torch.linalg.svd(linear)
        last = torch.det(u @ vt)
        linear = u @ torch.diag_embed(torch.stack([torch.ones_like(last), torch.ones_like(last), last], -1)) @ vt
    return moved, linear @ covars @ linear.transpose(1, 2)
