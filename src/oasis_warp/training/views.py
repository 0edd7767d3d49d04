"""Views of fixed geometry. Where only colours change, a picture is linear in them: image = W colours."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.types import Camera, Gaussians
from oasis_warp.ops import blend_weights


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, colors, weights, transposed):
        ctx.transposed = transposed
        return weights @ colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return (
            ctx.transposed @ grad,  # colors
            None,  # weights
            None,  # transposed
        )


class FrozenView(NamedTuple):
    """One view of Gaussians whose geometry is fixed."""

    weights: Tensor
    """Sparse [H W, N]: the share of each Gaussian in each pixel."""
    transposed: Tensor
    """The same, transposed, for the gradient."""
    alpha: Float[Tensor, "H W"]

    def image(self, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 3"]:
        """The picture over black."""
        return _Blend.apply(colors, self.weights, self.transposed).view(*self.alpha.shape, 3)


def freeze_view(gaussians: Gaussians, camera: Camera) -> FrozenView:
    """Blend once; afterwards a picture costs one sparse product."""
    weights = blend_weights(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities,
        camera.viewmat.to(gaussians.means), camera.K.to(gaussians.means), camera.width, camera.height,
    )  # fmt: skip
    transposed = weights.to_sparse_csc().transpose(0, 1)
    alpha = weights @ torch.ones(len(gaussians.means), 1, dtype=gaussians.means.dtype, device=gaussians.means.device)
    return FrozenView(weights, transposed, alpha.view(camera.height, camera.width))


def reference_azimuths(count: int) -> list[float]:
    """Angles of `count` views around the hand, evenly spaced, the photo's own (0) left out [rad]."""
    return [2 * math.pi * k / (count + 1) for k in range(1, count + 1)]
