"""The picture as a linear function of the colours: one sparse matrix for fixed geometry and camera."""

import warnings
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from warp import vec4i

from oasis_kernels import constants
from oasis_kernels import rasterize_weights as kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._blend_tiles import CUDA_LANES, lane_grid
from oasis_warp.ops._launch import SCALAR, VEC4, launch_ranges, view
from oasis_warp.ops._registration import revealed
from oasis_warp.ops._scene_checks import check_cameras, check_gaussians
from oasis_warp.ops._tiles import bin_to_tiles, even_work
from oasis_warp.ops.projection import project


class BlendWeights(NamedTuple):
    """Weight alpha T of every Gaussian in every pixel; pixels are numbered row by row."""

    matrix: Tensor
    """Sparse CSR [H*W, N], int32 indices, sorted; `matrix @ colors` is the image over black."""
    transpose: Tensor
    """The same, sparse CSR [N, H*W]: gradients by the colours are a product with it."""
    alphas: Float[Tensor, "H W 1"]
    """What the Gaussians cover: the row sums. The background shows through 1 - alphas."""


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
        width: Of the image [px].
        height: Of the image [px].
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
    check_cameras(
        viewmat[None], K[None], means, width, height, near_plane, far_plane, radius_clip, eps2d, tile_size
    )
    n, pixels, dtype, device = len(means), width * height, means.dtype, means.device
    with torch.no_grad():
        projection = project(
            means, quats, scales, opacities, viewmat[None], K[None], width, height,
            near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d, validate=validate,
        )  # fmt: skip
        tiles = bin_to_tiles(projection.boxes, projection.sort_depths, width, height, tile_size)
        opacities = opacities.contiguous()
        scratch = torch.empty(pixels, dtype=dtype, device=device)
        counts = torch.empty(pixels, dtype=torch.int32, device=device)
        lanes, lane_width, lane_height = lane_grid(tile_size, device, CUDA_LANES)

        def weigh(write: bool, starts: Tensor, columns: Tensor, values: Tensor) -> None:
            launch_ranges(
                kernels.weigh(SCALAR[dtype]),
                even_work(tiles.starts),
                [
                    view(tiles.starts), view(revealed(tiles.gaussians)), view(projection.boxes.view(-1, 4), vec4i),
                    view(projection.centers.view(-1, 4), VEC4[dtype]),
                    view(projection.whitenings.view(-1, 4), VEC4[dtype]), view(opacities),
                    tiles.size, lane_width, lane_height, tiles.across, tiles.down, width, height, int(write),
                    view(starts), view(scratch), view(counts), view(columns), view(values),
                ],
                like=means,
                lanes=lanes,
            )  # fmt: skip

        starts = torch.zeros(pixels + 1, dtype=torch.int64, device=device)
        columns, values = torch.empty(0, dtype=torch.int32, device=device), torch.empty(0, dtype=dtype, device=device)
        weigh(False, starts, columns, values)
        starts[1:] = counts.cumsum(0)
        n_weights = int(starts[-1])
        if n_weights > 2**31 - 1:
            raise ValueError(f"width: expected at most {2**31 - 1} weights, got {n_weights}. Draw a smaller image.")
        columns, values = columns.new_empty(n_weights), values.new_empty(n_weights)
        weigh(True, starts, columns, values)

        # Two stable sorts: by Gaussian gives the transpose, and that by pixel gives rows with sorted columns.
        rows = torch.repeat_interleave(torch.arange(pixels, dtype=torch.int32, device=device), counts)
        columns, by_gaussian = torch.sort(columns, stable=True)
        rows, values = rows[by_gaussian], values[by_gaussian]
        transpose = _csr(columns, rows, values, (n, pixels))
        rows, by_pixel = torch.sort(rows, stable=True)
        matrix = _csr(rows, columns[by_pixel], values[by_pixel], (pixels, n))
        alphas = matrix @ torch.ones(n, 1, dtype=dtype, device=device)
    return BlendWeights(matrix, transpose, alphas.view(height, width, 1))


def _csr(rows: Tensor, columns: Tensor, values: Tensor, size: tuple[int, int]) -> Tensor:
    """Sparse matrix of sorted `rows`; int32 indices, which MKL multiplies fastest with."""
    ends = torch.arange(size[0] + 1, dtype=torch.int32, device=rows.device)
    starts = torch.searchsorted(rows, ends, out_int32=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        warnings.filterwarnings("ignore", message="Sparse invariant checks are implicitly disabled")  # torch < 2.13
        return torch.sparse_csr_tensor(starts, columns, values, size, check_invariants=False)


class _BlendColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor, matrix: Tensor, transpose: Tensor) -> Tensor:
        ctx.transpose = transpose
        return matrix @ colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor) -> tuple[Tensor | None, ...]:
        return (
            ctx.transpose @ g_image.contiguous(),
            None,  # matrix
            None,  # transpose
        )


def blend_colors(weights: BlendWeights, colors: Float[Tensor, "N D"]) -> Float[Tensor, "H W D"]:
    """The image of Gaussians of these `colors`, shape [N, D], over black; differentiable in them.

    Torch's own gradient of a sparse product transposes the matrix at every step, at sixty times the cost.

    Raises:
        ValueError: `colors` has another number of rows, or another type than the weights.
    """
    check_shape("colors", colors, weights.matrix.shape[1], "D", hint="One row for each Gaussian.")
    check_float("colors", colors, like=weights.alphas)
    height, width, _ = weights.alphas.shape
    image = _BlendColors.apply(colors.contiguous(), weights.matrix, weights.transpose)
    return image.view(height, width, colors.shape[1])
