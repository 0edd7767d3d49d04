"""Options of gsplat that act between projection and blending: antialiasing, and absolute gradients of means2d."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_kernels import constants
from oasis_warp.ops._runtime.records import Splats, records_of_camera
from oasis_warp.ops._runtime.weigh import weigh
from oasis_warp.ops.projection import Projection


def compensated_opacities(
    opacities: Float[Tensor, "C N"], covars2d: Float64[Tensor, "C N 3"], eps2d: float
) -> Float[Tensor, "C N"]:
    """Opacities times sqrt(det(S) / det(S + eps2d I)), S being the covariance in the image (Yu et al. 2024).

    Gaussians smaller than a pixel then become fainter, instead of wider alone.

    Args:
        opacities: In [0, 1], shape [C, N].
        covars2d: S + eps2d I as xx, xy, yy [px^2], shape [C, N, 3]; zeros where nothing is drawn.
        eps2d: Variance that the projection has added [px^2].
    """
    xx, xy, yy = covars2d.unbind(-1)
    drawn = xx > 0
    blurred = torch.where(drawn, xx * yy - xy * xy, 1)
    sharp = torch.where(drawn, (xx - eps2d) * (yy - eps2d) - xy * xy, 1)
    ratio = sharp / blurred
    positive = ratio > 0
    return opacities * torch.where(positive, torch.where(positive, ratio, 1).sqrt(), 0).to(opacities.dtype)


class _RecordAbsoluteGradients(torch.autograd.Function):
    """Identity on images and alphas; its backward sets `means2d.absgrad`."""

    @staticmethod
    def forward(
        ctx: Any, render: Tensor, alphas: Tensor, means2d: Tensor, projection: Projection, opacities: Tensor,
        channels: Tensor, backgrounds: Tensor, tile_size: int,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        ctx.save_for_backward(opacities, channels, backgrounds)
        ctx.means2d, ctx.projection, ctx.tile_size = means2d, projection, tile_size
        ctx.set_materialize_grads(True)
        return render.view_as(render), alphas.view_as(alphas)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_render: Tensor, g_alphas: Tensor) -> tuple[Tensor | None, ...]:
        opacities, channels, backgrounds = ctx.saved_tensors
        ctx.means2d.absgrad = absolute_gradients(
            ctx.projection, opacities, channels, backgrounds, g_render, g_alphas, ctx.tile_size
        )
        return (
            g_render,
            g_alphas,
            None,  # means2d
            None,  # projection
            None,  # opacities
            None,  # channels
            None,  # backgrounds
            None,  # tile_size
        )


def record_absolute_gradients(
    render: Tensor, alphas: Tensor, projection: Projection, opacities: Tensor, channels: Tensor, backgrounds: Tensor,
    tile_size: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """`render` and `alphas` of `blend`, such that backward sets `projection.means2d.absgrad`, shape [C, N, 2]."""
    detached = Projection(*(part.detach() for part in projection))
    return _RecordAbsoluteGradients.apply(
        render, alphas, projection.means2d, detached, opacities.detach(), channels.detach(), backgrounds.detach(),
        tile_size,
    )  # fmt: skip


def absolute_gradients(
    projection: Projection, opacities: Tensor, channels: Tensor, backgrounds: Tensor, g_render: Tensor,
    g_alphas: Tensor, tile_size: int,
) -> Float[Tensor, "C N 2"]:  # fmt: skip
    """Sums over pixels of |gradient by means2d| (Ye et al. 2024) [loss per px], shape [C, N, 2].

    The weights of every pair of a pixel and a Gaussian are listed front to back. With w = alpha T, the gradient by
    alpha is T g.c - (sum of w g.c behind + T_end (g.background - g_alpha)) / (1 - alpha).
    """
    _, height, width, _ = g_render.shape
    result = torch.zeros_like(projection.means2d)
    n_cameras, n = projection.depths.shape
    for c in range(n_cameras):
        records = records_of_camera(projection.records, c, n_cameras, n, opacities.dtype)
        splats = Splats(records, opacities[c : c + 1].contiguous(), channels[c : c + 1], backgrounds[c : c + 1])
        weights = weigh(splats, width, height, tile_size)
        pairs = _Pairs.front_to_back(weights.pixel_starts, weights.gaussians, weights.by_pixel, splats)
        behind_all = (g_render[c] * backgrounds[c]).sum(-1).flatten() - g_alphas[c].flatten()
        moments = pairs.moments(g_render[c].flatten(0, 1), behind_all, splats, width)
        result[c] = torch.zeros(n, 2, dtype=torch.float64, device=result.device).index_add_(
            0, pairs.gaussian, moments.abs()
        )
    return result


class _Pairs(NamedTuple):
    """Pairs of a pixel and a Gaussian with a weight, pixel by pixel, front to back; sums are float64."""

    pixel: Int[Tensor, "P"]
    gaussian: Int[Tensor, "P"]
    weight: Float64[Tensor, "P"]
    first: Int[Tensor, "P"]
    """Place of the first pair of the same pixel."""
    last: Int[Tensor, "P"]

    @classmethod
    def front_to_back(cls, starts: Tensor, gaussians: Tensor, weights: Tensor, splats: Splats) -> "_Pairs":
        """The entries of a sparse matrix of weights, a row per pixel, in the order in which layers are blended."""
        starts = starts.long()
        counts = starts.diff()
        pixel = torch.repeat_interleave(counts)
        rank = splats.tables().sort_depths[0].argsort(stable=True).argsort()
        order = (pixel * len(rank) + rank[gaussians.long()]).argsort()
        return cls(pixel, gaussians.long()[order], weights[order].double(), starts[pixel], starts[pixel + 1] - 1)

    def sums_up_to(self, values: Tensor) -> Tensor:
        """Sum of `values` over the pairs of the same pixel, up to and including each."""
        sums = values.cumsum(0)
        return sums - (sums - values)[self.first]

    def moments(self, g_render: Tensor, g_end: Tensor, splats: Splats, width: int) -> Float64[Tensor, "P 2"]:
        """Gradient by means2d of each pair. `g_end` is that by the transmittance behind all layers, per pixel."""
        weight, centers, whitenings = self.weight, *(table[0].double() for table in splats.tables()[:2])
        through = 1 - self.sums_up_to(weight)  # transmittance behind each layer
        in_front = through + weight
        alpha = weight / in_front
        by_color = (g_render[self.pixel] * splats.colors[0][self.gaussian]).sum(-1).double()
        colored = self.sums_up_to(weight * by_color)
        behind = colored[self.last] - colored + through[self.last] * g_end.double()[self.pixel]
        by_alpha = in_front * by_color - behind / (1 - alpha)
        by_alpha = torch.where(alpha < constants.ALPHA_MAX * (1 - 1e-6), by_alpha, 0)  # where alpha is not capped
        center, w = centers[self.gaussian], whitenings[self.gaussian]
        x = self.pixel % width + 0.5 - center[:, 0] - center[:, 2]
        y = torch.div(self.pixel, width, rounding_mode="floor") + 0.5 - center[:, 1] - center[:, 3]
        u, v = w[:, 0] * x + w[:, 1] * y, w[:, 2] * x + w[:, 3] * y
        conic_offset = torch.stack([w[:, 0] * u + w[:, 2] * v, w[:, 1] * u + w[:, 3] * v], -1)
        return (by_alpha * alpha)[:, None] * conic_offset
