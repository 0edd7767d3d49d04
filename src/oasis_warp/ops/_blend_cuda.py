"""Blend float32 Gaussians on CUDA, a block of warps a tile."""

from typing import NamedTuple

import torch
from torch import Tensor
from warp import vec2f, vec3d, vec4f, vec4i
from warp.types import vector

from oasis_kernels import cuda_binning, cuda_draw, cuda_draw_backward
from oasis_warp.ops._launch import SCALAR, launch, view
from oasis_warp.ops._registration import hidden, hidden_like_fake, revealed
from oasis_warp.ops._rules import current_rules
from oasis_warp.ops._splats import Frame, Gradients, Splats, Wanted
from oasis_warp.ops._tiles import check_pairs


class Lists(NamedTuple):
    """Which Gaussians each tile draws. P pairs of a Gaussian and a tile."""

    starts: Tensor
    """[tiles + 1], int32: first place of each tile's list; at the end P."""
    pair_starts: Tensor
    """[M], int32: number of each Gaussian's first pair."""
    gaussians: Tensor
    """`hidden` [P], int32: Gaussians, nearest first."""


class Kept(NamedTuple):
    """What the adjoint needs."""

    transmittance: Tensor
    """[C, H, W], of the end."""
    stops: Tensor
    """[C, H, W], int32: place in the tile's list of the first Gaussian that was not drawn."""
    starts: Tensor
    """As in `Lists`, like all below."""
    pair_starts: Tensor
    gaussians: Tensor


def _count_tiles(width: int, height: int) -> tuple[int, int]:
    """Tiles across and down an image."""
    return -(-width // cuda_binning.TILE), -(-height // cuda_binning.TILE)


def _bin(splats: Splats, width: int, height: int) -> tuple[Lists, Tensor, bool]:
    """Lists of the tiles, sorting keys in their place, and whether the lists are sorted already."""
    n_cameras, n = splats.depths.shape
    device = splats.depths.device
    across, down = _count_tiles(width, height)
    n_tiles = n_cameras * across * down
    counts, cursors, total = torch.zeros(2 * n_tiles + 1, dtype=torch.int32, device=device).split([n_tiles, n_tiles, 1])
    pair_starts = torch.empty(n_cameras * n, dtype=torch.int32, device=device)
    boxes = view(splats.boxes.view(-1, 4), vec4i)
    launch(
        cuda_binning.count_pairs,
        n_cameras * n,
        [n, boxes, across, down, view(pair_starts), view(counts), view(total)],
        like=counts,
    )
    ends = counts.cumsum(0)
    # The one moment at which the host waits for the device: only the data knows how much memory it takes.
    n_pairs, longest = torch.stack([ends[-1], counts.max()]).tolist() if n else (0, 0)
    check_pairs(n_pairs)
    starts = torch.nn.functional.pad(ends, (1, 0)).int()
    keys = torch.empty(n_pairs, dtype=torch.int64, device=device)
    launch(
        cuda_binning.fill_tiles,
        n_cameras * n,
        [
            n, boxes, view(splats.depths.view(-1)), across, down, view(starts), view(cursors), view(keys),
        ],
        like=keys,
    )  # fmt: skip
    lists = Lists(starts, pair_starts, hidden(n_pairs, torch.int32, device))
    if longest > cuda_draw.LONGEST:
        _sort(keys, counts, across * down, n, revealed(lists.gaussians))
    return lists, keys, longest > cuda_draw.LONGEST


def _sort(keys: Tensor, counts: Tensor, tiles_a_camera: int, n: int, gaussians: Tensor) -> None:
    """Fill in the sorted lists by torch's sort over all pairs, for tiles that a block cannot sort by itself."""
    tiles = torch.repeat_interleave(torch.arange(len(counts), device=keys.device), counts)
    keys, by_depth = torch.sort(keys)
    tiles, by_tile = torch.sort(tiles[by_depth], stable=True)
    index = keys[by_tile] & ((1 << cuda_binning.INDEX_BITS) - 1)
    gaussians.copy_(tiles // tiles_a_camera * n + index)


def kept_like(colors: Tensor, frame: Frame) -> Kept:
    """Empty tensors of the shapes that `draw` keeps."""
    n_cameras, n, _ = colors.shape
    across, down = _count_tiles(frame.width, frame.height)

    def empty(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return colors.new_empty(shape, dtype=dtype)

    return Kept(
        empty(n_cameras, frame.height, frame.width, dtype=torch.float32),
        empty(n_cameras, frame.height, frame.width),
        empty(n_cameras * across * down + 1),
        empty(n_cameras * n),
        hidden_like_fake(torch.int32, colors.device),
    )


def draw(splats: Splats, frame: Frame, keep: bool) -> tuple[Tensor, Tensor, Kept | None]:
    """Images over the backgrounds, alpha, and what the adjoint needs if it is to be kept.

    Raises:
        ValueError: more pairs of a Gaussian and a tile than can be numbered.
    """
    width, height, _ = frame
    n_cameras, n, channels = splats.colors.shape
    color = vector(channels, SCALAR[torch.float32])
    across, down = _count_tiles(width, height)
    lists, keys, in_order = _bin(splats, width, height)

    def empty(*shape: int) -> Tensor:
        return splats.colors.new_empty(n_cameras, height, width, *shape)

    image, alphas, transmittance = empty(channels), empty(1), empty()
    stops = transmittance.new_empty(transmittance.shape, dtype=torch.int32)
    launch(
        cuda_draw.blend(channels, current_rules()),
        (n_cameras * across * down, cuda_draw.BLOCK),
        [
            n, view(lists.starts), view(keys), int(in_order), view(splats.centers.view(-1, 4), vec4f),
            view(splats.whitenings.view(-1, 4), vec4f), view(splats.opacities.view(-1)),
            view(splats.colors.view(-1, channels), color), view(splats.backgrounds, color), across, down, width,
            height, view(image.view(-1, channels), color), view(alphas.view(-1)), view(transmittance.view(-1)),
            view(stops.view(-1)), view(revealed(lists.gaussians)),
        ],
        like=image,
        block_dim=cuda_draw.BLOCK,
    )  # fmt: skip
    return image, alphas, Kept(transmittance, stops, *lists) if keep else None


def draw_backward(
    g_image: Tensor | None, g_alpha: Tensor | None, splats: Splats, frame: Frame, kept: Kept, wanted: Wanted
) -> Gradients:
    """Gradients from those by image and alpha, None standing for zeros."""
    width, height, _ = frame
    with_shape, with_colors, with_backgrounds = wanted
    n_cameras, n, channels = splats.colors.shape
    color, moments = (vector(k, SCALAR[torch.float32]) for k in (channels, 8))
    across, down = _count_tiles(width, height)
    pixels, n_tiles = n_cameras * height * width, n_cameras * across * down
    new = splats.colors
    of_image = new.new_zeros(pixels, channels) if g_image is None else g_image.view(-1, channels)
    of_alpha = new.new_zeros(pixels) if g_alpha is None else g_alpha.view(-1)
    gaussians = revealed(kept.gaussians)
    n_pairs, total = len(gaussians), n_cameras * n
    pair_moments = new.new_empty(n_pairs if with_shape else 0, 8)
    pair_colors = new.new_empty(n_pairs if with_colors else 0, channels)
    tile_backgrounds = new.new_empty(n_tiles, channels)
    boxes, whitenings = view(splats.boxes.view(-1, 4), vec4i), view(splats.whitenings.view(-1, 4), vec4f)
    opacities = view(splats.opacities.view(-1))
    launch(
        cuda_draw_backward.blend_backward(channels, current_rules()),
        (n_tiles, cuda_draw.BLOCK),
        [
            view(kept.starts), view(gaussians), view(kept.pair_starts), boxes,
            view(splats.centers.view(-1, 4), vec4f), whitenings, opacities,
            view(splats.colors.view(-1, channels), color), view(splats.backgrounds, color), across, down, width,
            height, view(kept.transmittance.view(-1)), view(kept.stops.view(-1)), view(of_image, color), view(of_alpha),
            int(with_shape), int(with_colors), view(pair_moments, moments), view(pair_colors, color),
            view(tile_backgrounds, color),
        ],
        like=new,
        block_dim=cuda_draw.BLOCK,
    )  # fmt: skip
    g_means2d = new.new_empty(total if with_shape else 0, 2)
    g_covars2d = new.new_empty(total if with_shape else 0, 3, dtype=torch.float64)
    g_opacities = new.new_empty(total if with_shape else 0)
    g_colors = new.new_empty(total if with_colors else 0, channels)
    if with_shape or with_colors:
        launch(
            cuda_draw_backward.gather(channels),
            total,
            [
                boxes, view(kept.pair_starts), view(pair_moments, moments), view(pair_colors, color), whitenings,
                opacities, int(with_shape), int(with_colors), view(g_means2d, vec2f), view(g_covars2d, vec3d),
                view(g_opacities), view(g_colors, color),
            ],
            like=new,
        )  # fmt: skip
    return Gradients(
        g_means2d.view(n_cameras, n, 2) if with_shape else None,
        g_covars2d.view(n_cameras, n, 3) if with_shape else None,
        g_opacities.view(n_cameras, n) if with_shape else None,
        g_colors.view(n_cameras, n, channels) if with_colors else None,
        tile_backgrounds.view(n_cameras, across * down, channels).sum(1) if with_backgrounds else None,
    )
