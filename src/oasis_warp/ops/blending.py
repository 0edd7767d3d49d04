"""Projected Gaussians -> image and alpha, differentiable in positions, shapes, opacities, colours and backgrounds.

Also gsplat's options between projection and blending: antialiasing, and absolute gradients of means2d.
"""

from types import ModuleType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_kernels import constants
from oasis_kernels.rasterize.tiles_cuda import INDEX_BITS
from oasis_warp.core.sums import add_at
from oasis_warp.ops._runtime import blend_cuda, blend_strips, blend_tiles
from oasis_warp.ops._runtime.declaration import Array, Operator, needs_gradient
from oasis_warp.ops._runtime.launch import contiguous, has_vectors
from oasis_warp.ops._runtime.records import Frame, GradientFlags, Splats, records_of_camera
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops._runtime.weigh import weigh
from oasis_warp.ops.projection import Projection


def _backend(colors: Tensor) -> ModuleType:
    """The backend that blends Gaussians with these colours [C, N, D]."""
    if has_vectors(colors):
        return blend_strips
    if colors.is_cuda and colors.dtype == torch.float32 and colors.shape[1] <= 1 << INDEX_BITS:
        return blend_cuda
    return blend_tiles


def _splats(records: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor) -> Splats:
    rows = blend_cuda.contiguous if _backend(colors) is blend_cuda else Tensor.contiguous
    return Splats(records, rows(opacities), rows(colors), backgrounds.contiguous())


# Sizes and flags come in lists: each argument of an op costs torch time.
def _blend(
    means2d: Tensor, covars2d: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor, records: Tensor,
    frame: list[int], keep: bool, validate: bool,
) -> tuple[Tensor, Tensor, list[Tensor]]:  # fmt: skip
    if validate:
        shared = colors.stride(0) == 0  # by the cameras: each value counts once
        check_finite(colors=colors[:1] if shared else colors, backgrounds=backgrounds)
    splats = _splats(records, opacities, colors, backgrounds)
    image, alphas, saved = _backend(colors).draw(splats, Frame(*frame), keep)
    return image, alphas, [] if saved is None else list(saved)


def _blend_fake(
    means2d: Any, covars2d: Any, opacities: Any, colors: Tensor, backgrounds: Any, records: Any, frame: list[int],
    keep: bool, validate: bool,
) -> tuple[Tensor, Tensor, list[Tensor]]:  # fmt: skip
    n_cameras, _, channels = colors.shape
    width, height, _ = frame
    image, alphas = (colors.new_empty(n_cameras, height, width, k) for k in (channels, 1))
    return image, alphas, list(_backend(colors).fake_saved(colors, Frame(*frame))) if keep else []


def _blend_backward(
    opacities: Tensor, colors: Tensor, backgrounds: Tensor, records: Tensor, saved: list[Tensor], frame: list[int],
    g_image: Tensor | None, g_alphas: Tensor | None, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    splats = _splats(records, opacities, colors, backgrounds)
    backend, flags = _backend(colors), GradientFlags(any(needs[:3]), *needs[3:])
    gradients = backend.draw_backward(
        *contiguous(g_image, g_alphas), splats, Frame(*frame), backend.SavedTensors(*saved), flags
    )
    return [colors.new_empty(0) if g is None else g for g in gradients]


def _blend_backward_fake(
    opacities: Any, colors: Tensor, backgrounds: Any, records: Any, saved: Any, frame: Any, g_image: Any, g_alphas: Any,
    needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    n_cameras, n, channels = colors.shape
    shape = any(needs[:3])
    gradients = [
        (shape, (n_cameras, n, 2), colors.dtype),
        (shape, (n_cameras, n, 3), torch.float64),
        (shape, (n_cameras, n), colors.dtype),
        (needs[3], (n_cameras, n, channels), colors.dtype),
        (needs[4], (n_cameras, channels), colors.dtype),
    ]
    return [
        colors.new_empty(shape, dtype=dtype) if needed else colors.new_empty(0) for needed, shape, dtype in gradients
    ]


_OPERATOR = Operator(
    "blend",
    _blend,
    _blend_fake,
    _blend_backward,
    _blend_backward_fake,
    inputs={
        "means2d": Array("C N 2", grad=True),
        "covars2d": Array("C N 3", grad=True),
        "opacities": Array("C N", grad=True),
        "colors": Array("C N D", grad=True),
        "backgrounds": Array("C D", grad=True),
    },
    outputs={"image": "C H W D", "alphas": "C H W 1"},
    auxiliary={"saved": "..."},
    validates_itself=True,
    caller="rasterization",
    public=False,
)


def blend(
    projection: Projection,
    opacities: Float[Tensor, "C N"],
    colors: Float[Tensor, "C N D"],
    backgrounds: Float[Tensor, "C D"],
    width: int,
    height: int,
    tile_size: int,
    *,
    validate: bool = False,
) -> tuple[Float[Tensor, "C H W D"], Float[Tensor, "C H W 1"]]:
    """Images over the backgrounds, and alpha (Kerbl et al. 2023, eq. 3): sum of c alpha T, and sum of alpha T.

    D is at most 32. `projection.means2d` and `projection.covars2d` receive gradients.

    Raises:
        ValueError: with `validate`, colours or backgrounds that are not finite.
    """
    channels = colors.shape[-1]
    padding = next(c for c in constants.CHANNELS if c >= channels) - channels
    if padding:
        colors = torch.nn.functional.pad(colors, (0, padding))
        backgrounds = torch.nn.functional.pad(backgrounds, (0, padding))
    means2d, covars2d = projection.means2d, projection.covars2d
    image, alphas, _ = _OPERATOR(
        means2d, covars2d, opacities, colors, backgrounds, projection.records, [width, height, tile_size],
        needs_gradient(means2d, covars2d, opacities, colors, backgrounds), validate,
    )  # fmt: skip
    return (image[..., :channels] if padding else image), alphas


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
        zeros = torch.zeros(n, 2, dtype=torch.float64, device=result.device)
        result[c] = add_at(zeros, pairs.gaussian, moments.abs())
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
