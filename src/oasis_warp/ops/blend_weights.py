"""The picture as a linear function of the colours: one sparse matrix for fixed geometry and camera."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels import constants
from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.rasterization_checks import check_cameras, check_gaussians
from oasis_warp.ops._runtime.records import Splats
from oasis_warp.ops._runtime.transforms import in_forward_mode, refuse_forward_mode
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops._runtime.weigh import weigh
from oasis_warp.ops.checks import check_float, check_shape
from oasis_warp.ops.projection import Projection, check_focal_lengths, project


class BlendWeights(NamedTuple):
    """Weight alpha T of every Gaussian in every pixel; pixels are numbered row by row."""

    matrix: Tensor
    """Sparse CSR [H*W, N], int32 indices, sorted; `matrix @ colors` is the image over black."""
    transpose: Tensor
    """The same, sparse CSR [N, H*W]: gradients by the colours are a product with it."""
    alphas: Float[Tensor, "H W 1"]
    """Coverage by the Gaussians, the row sums. The share of the background is 1 - alphas."""


WEIGHTS = Declaration(
    "blend_weights",
    inputs={
        "means": Array("N 3"), "quats": Array("N 4"), "scales": Array("N 3"), "opacities": Array("N"),
        "viewmat": Array("4 4"), "K": Array("3 3"),
    },
    outputs={"matrix": "HW N", "transpose": "N HW", "alphas": "H W 1"},
)  # fmt: skip
COLORS = Declaration("blend_colors", inputs={"colors": Array("N D", grad=True)}, outputs={"image": "H W D"})


def blend_weights(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = constants.EPS2D,
    tile_size: int = 16,
    validate: bool = True,
) -> BlendWeights:
    """The weights with which `rasterization` blends, for one camera: image = matrix @ colors + (1 - alphas) background.

    For fitting colours to pictures with everything else fixed: two sparse products, `blend_colors`, replace a forward
    and a backward pass. Not differentiable.

    Args:
        means: Centres [m], shape [N, 3].
        quats: Rotations wxyz of any positive norm, shape [N, 4].
        scales: Standard deviations [m], shape [N, 3].
        opacities: In [0, 1], shape [N].
        viewmat: World to camera, shape [4, 4].
        K: Intrinsics [px], shape [3, 3].
        width: Width of the image [px].
        height: Height of the image [px].
        near_plane: This and the rest as in `rasterization`.
        far_plane: See there.
        radius_clip: See there.
        eps2d: See there.
        tile_size: See there.
        validate: See there.

    Raises:
        ValueError: as in `rasterization`, or more weights than int32 can count.
    """
    check_shape("viewmat", viewmat, 4, 4)
    check_shape("K", K, 3, 3)
    check_gaussians(means, quats, scales, None, opacities)
    if in_forward_mode():
        refuse_forward_mode("blend_weights", (means, quats, scales, opacities, viewmat, K))
    for name, tensor in (("viewmat", viewmat), ("K", K)):
        check_float(name, tensor, like=means)
    if validate:
        check_finite(viewmat=viewmat, K=K)
        check_focal_lengths("K", K)
    check_cameras(viewmat[None], K[None], means, width, height, near_plane, far_plane, radius_clip, eps2d, tile_size)
    with torch.no_grad():
        projection = project(
            means, quats, scales, opacities, viewmat[None], K[None], width, height,
            near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d, validate=validate,
        )  # fmt: skip
        return _weights_of(projection, opacities, width, height, tile_size)


def _weights_of(projection: Projection, opacities: Tensor, width: int, height: int, tile_size: int) -> BlendWeights:
    n, pixels = len(opacities), width * height
    nothing = opacities.new_empty(1, n, 0), opacities.new_empty(1, 0)
    w = weigh(Splats(projection.records, opacities[None].contiguous(), *nothing), width, height, tile_size)
    matrix = _csr(w.pixel_starts, w.gaussians, w.by_pixel, (pixels, n))
    transpose = _csr(w.gaussian_starts, w.pixels, w.by_gaussian, (n, pixels))
    return BlendWeights(matrix, transpose, w.alphas.view(height, width, 1))


def _csr(starts: Tensor, columns: Tensor, values: Tensor, size: tuple[int, int]) -> Tensor:
    """Sparse matrix with int32 indices, which MKL multiplies fastest with."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        warnings.filterwarnings("ignore", message="Sparse invariant checks are implicitly disabled")  # torch < 2.13
        return torch.sparse_csr_tensor(starts, columns, values, size, check_invariants=False)


def check_weights_type(name: str, weights: BlendWeights) -> None:
    """Refuse what `blend_weights` does not return.

    Raises:
        TypeError: names the argument.
    """
    if not isinstance(weights, BlendWeights):
        raise TypeError(f"{name}: expected BlendWeights of blend_weights, got {type(weights).__name__}.")


def stack_weights(views: Sequence[BlendWeights]) -> BlendWeights:
    """Several pictures, one below the other, as one; the Gaussians of each follow upon those of the one before.

    `blend_colors(stacked, torch.cat([colors of each]))` draws them all, each in colours of its own.

    Args:
        views: Views of equal width, on one device.

    Raises:
        TypeError: another type.
        ValueError: none, of different widths, or more weights than int32 can count.
    """
    if not views:
        raise ValueError("views: expected at least one, got none.")
    for view in views:
        check_weights_type("views", view)
    width = views[0].alphas.shape[1]
    for view in views[1:]:
        if view.alphas.shape[1] != width:
            raise ValueError(
                f"views: expected pictures {width} pixels wide, got {view.alphas.shape[1]}. Draw all of one size."
            )
    if len(views) == 1:
        return views[0]
    count = sum(view.matrix.values().numel() for view in views)
    if count > torch.iinfo(torch.int32).max:
        raise ValueError(f"views: expected at most 2**31 - 1 weights in all, got {count}. Draw smaller pictures.")
    matrix, transpose = (_diagonal(parts) for parts in zip(*((v.matrix, v.transpose) for v in views), strict=True))
    return BlendWeights(matrix, transpose, torch.cat([view.alphas for view in views]))


def _diagonal(parts: Sequence[Tensor]) -> Tensor:
    """The CSR matrix with `parts` as its diagonal blocks."""
    starts, columns, rows, width, count = [parts[0].crow_indices()[:1]], [], 0, 0, 0
    for part in parts:
        starts.append(part.crow_indices()[1:] + count)
        columns.append(part.col_indices() + width)
        rows, width, count = rows + part.shape[0], width + part.shape[1], count + part.values().numel()
    values = torch.cat([part.values() for part in parts])
    return _csr(torch.cat(starts).int(), torch.cat(columns).int(), values, (rows, width))


@dataclass(frozen=True)
class _Matrix:
    """A sparse matrix and its transpose. Transforms of torch.func, which know no sparse tensors, do not look inside."""

    matrix: Tensor
    transpose: Tensor


class _BlendColors(torch.autograd.Function):
    @staticmethod
    def forward(colors: Tensor, by: _Matrix) -> Tensor:
        return by.matrix @ colors

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, _Matrix], output: Tensor) -> None:
        ctx.by = inputs[1]

    @staticmethod
    def backward(ctx: Any, g_image: Tensor) -> tuple[Tensor | None, ...]:
        return (
            _BlendColors.apply(g_image.contiguous(), _Matrix(ctx.by.transpose, ctx.by.matrix)),
            None,  # by
        )

    @staticmethod
    def jvp(ctx: Any, colors: Tensor, _: None) -> Any:
        return _BlendColors.apply(colors.contiguous(), ctx.by)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int, None], colors: Tensor, by: _Matrix) -> tuple[Any, int]:
        columns = colors.movedim(in_dims[0], -1)  # the products of all entries are one of more columns
        image: Any = _BlendColors.apply(columns.flatten(1), by)
        return image.view(-1, *columns.shape[1:]), 2


def blend_colors(
    weights: BlendWeights, colors: Float[Tensor, "N D"], *, validate: bool = True
) -> Float[Tensor, "H W D"]:
    """The image of Gaussians of these `colors`, shape [N, D], over black; differentiable in them, any number of times.

    Torch's own gradient of a sparse product transposes the matrix at every step, at sixty times the cost.

    Args:
        weights: Weights of `blend_weights`.
        colors: One row for each Gaussian.
        validate: Refuse colours that are not finite. Waits for a CUDA device; switch it off for trusted inputs.

    Raises:
        TypeError: `weights` or `colors` are of another type.
        ValueError: `colors` has another number of rows, or another dtype than the weights, or is not finite.
    """
    check_weights_type("weights", weights)
    check_shape("colors", colors, weights.matrix.shape[1], "D", hint="One row for each Gaussian.")
    check_float("colors", colors, like=weights.alphas)
    if validate and not is_traced():
        check_finite(colors=colors)
    height, width, _ = weights.alphas.shape
    image: Any = _BlendColors.apply(colors.contiguous(), _Matrix(weights.matrix, weights.transpose))
    return image.view(height, width, colors.shape[1])
