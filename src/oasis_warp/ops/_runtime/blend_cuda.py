"""Blend float32 Gaussians on CUDA, one block of warps per tile.

Each tensor costs torch more time than some kernels run, so tensors here hold several arrays each.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_kernels.rasterize import tiles_cuda
from oasis_warp.ops._runtime.blend_tiles import MAX_PAIRS, check_pairs, fake_opaque_buffer, opaque_buffer
from oasis_warp.ops._runtime.launch import block_count, current_stream, run_cuda, wait_for
from oasis_warp.ops._runtime.pair_counts import Counts, remember, thread_slot, watching
from oasis_warp.ops._runtime.records import Frame, GradientFlags, Gradients, Size, Splats
from oasis_warp.ops._runtime.rules import current_rules

MAX_CHECKPOINTS = 1 << 16
"""Tiles times numbers per pixel up to which lists are cut into segments. Beyond, the tiles alone fill a device, and the
memory for segments would outgrow the images."""


class SavedTensors(NamedTuple):
    """Tensors saved for the adjoint."""

    planes: Tensor
    """float32: [C, H, W] transmittance at the end; [C, H, W] bits of int32, place in the tile's list of the first
    Gaussian that was not drawn; what happens between the segments of the lists (`checkpoints` of `blending.cu`)."""
    lists: Tensor
    """int32: [tiles, 4] column, start and length of the list, row over all cameras of a tile, those with any list
    first; [tiles, spread] cursors, of no further use; [C, N] number of each Gaussian's first pair."""
    gaussians: Tensor
    """`opaque_buffer` [pairs], int32: the lists, nearest first."""


class Layout(NamedTuple):
    """Sizes of one call."""

    n_cameras: int
    n: int
    channels: int
    tiles_x: int
    tiles_y: int
    width: int
    height: int
    n_tiles: int
    pixels: int
    segments: int
    """Parts that the lists are cut into."""

    def size_of_planes(self) -> Size:
        """Numbers of `SavedTensors.planes`."""
        return 2 * self.pixels + self.n_tiles * (self.segments - 1) * (self.channels + 1) * 64

    def size_of_lists(self) -> Size:
        """Numbers of `SavedTensors.lists`."""
        return (4 + tiles_cuda.spread_of(self.n_tiles)) * self.n_tiles + self.n_cameras * self.n


def layout_of(n_cameras: int, n: int, channels: int, frame: Frame) -> Layout:
    """Sizes for so many cameras, Gaussians and channels."""
    width, height, _ = frame
    across, down = -(-width // tiles_cuda.TILE), -(-height // tiles_cuda.TILE)
    n_tiles = n_cameras * across * down
    segments = tiles_cuda.SEGMENTS if n_tiles * (channels + 1) <= MAX_CHECKPOINTS else 1
    return Layout(n_cameras, n, channels, across, down, width, height, n_tiles, n_cameras * height * width, segments)


def _params(splats: Splats, layout: Layout, lists: Tensor, planes: Tensor | None) -> dict[str, Any]:
    """Parameters of the kernels: sizes, Gaussians, the arrays of `SavedTensors.lists` and `SavedTensors.planes`."""
    first, plane = lists.data_ptr(), 0 if planes is None else planes.data_ptr()
    n_cameras, n, _, tiles_x, tiles_y, width, height, n_tiles, pixels, _ = layout
    spread = tiles_cuda.spread_of(n_tiles)
    return {
        **splats.params(), "opacity_step": _step(splats.opacities), "color_step": _step(splats.colors), "n": n,
        "n_cameras": n_cameras, "total": n_cameras * n,
        "tiles_x": tiles_x, "tiles_y": tiles_y, "width": width, "height": height, "n_tiles": n_tiles, "tiles": first,
        "cursors": first + 16 * n_tiles, "pair_starts": first + (16 + 4 * spread) * n_tiles, "spread": spread,
        "transmittance": plane, "stops": plane and plane + 4 * pixels, "checkpoints": plane and plane + 8 * pixels,
    }  # fmt: skip


def contiguous(tensor: Tensor) -> Tensor:
    """`tensor` [C, N, ...] with contiguous rows, which all cameras may share."""
    return tensor if tensor.stride(0) == 0 and tensor[0].is_contiguous() else tensor.contiguous()


def _step(tensor: Tensor) -> int:
    """Rows from a camera's Gaussians to those of the next."""
    return 0 if tensor.stride(0) == 0 else tensor.shape[1]


def fake_saved(colors: Tensor, frame: Frame) -> SavedTensors:
    """Empty tensors of the shapes that `draw` saves."""
    layout = layout_of(*colors.shape, frame)
    return SavedTensors(
        colors.new_empty(layout.size_of_planes()),
        colors.new_empty(layout.size_of_lists(), dtype=torch.int32),
        fake_opaque_buffer(torch.int32, colors.device),
    )


def draw(splats: Splats, frame: Frame, keep: bool) -> tuple[Tensor, Tensor, SavedTensors | None]:
    """Images over the backgrounds, alpha, and, with `keep`, what the adjoint needs.

    Raises:
        ValueError: more pairs of a Gaussian and a tile than can be numbered.
        RuntimeError: a graph captures this without an eager call before, or without a watch.
    """
    layout, new = layout_of(*splats.colors.shape, frame), splats.colors
    n_cameras, n, channels = new.shape
    device, stream = new.device, current_stream(new.device)
    lists = torch.empty(layout.size_of_lists(), dtype=torch.int32, device=device)
    planes = new.new_empty(layout.size_of_planes()) if keep else None
    params = _params(splats, layout, lists, planes)
    kind = device, n_cameras, n, frame.width, frame.height
    capturing = torch.cuda.is_current_stream_capturing()
    report, counts = watching().expect(kind) if capturing else (thread_slot(), Counts(MAX_PAIRS, MAX_PAIRS))
    params |= {"capacity": counts.pairs, "longest_sorted": counts.longest, "report": report}
    blocks = block_count(n_cameras * n, tiles_cuda.COUNT_BLOCK)
    run_cuda(tiles_cuda.count_pairs(), params, blocks, stream)
    run_cuda(tiles_cuda.place_tiles(), params, block_count(layout.n_tiles, tiles_cuda.PLACE_BLOCK), stream)
    image = new.new_empty((n_cameras, frame.height, frame.width, channels))
    alphas = new.new_empty((n_cameras, frame.height, frame.width, 1))
    if not capturing:
        # The only point at which the host waits for the device: only the data knows how much memory is needed.
        wait_for(stream)
        counts = Counts(*report.tolist())
        check_pairs(counts.pairs)
        remember(kind, counts)
    long = counts.longest > tiles_cuda.LONGEST
    gaussians = opaque_buffer(counts.pairs, torch.int32, device) if keep or long else None
    keys = torch.empty(counts.pairs, dtype=torch.int64, device=device)
    params |= {
        "capacity": counts.pairs, "keys": keys, "image": image, "alphas": alphas, "tile_gaussians": gaussians,
    }  # fmt: skip
    run_cuda(tiles_cuda.fill_tiles(), params, blocks, stream)
    if long:
        params["spare"] = torch.empty_like(keys) if counts.longest > tiles_cuda.RUN else None
        run_cuda(tiles_cuda.sort_long_lists(), params, layout.n_tiles, stream)
    run_cuda(tiles_cuda.blend(channels, layout.segments, current_rules()), params, layout.n_tiles, stream)
    return image, alphas, None if planes is None or gaussians is None else SavedTensors(planes, lists, gaussians)


def draw_backward(
    g_image: Tensor | None, g_alpha: Tensor | None, splats: Splats, frame: Frame, saved: SavedTensors,
    flags: GradientFlags,
) -> Gradients:  # fmt: skip
    """Gradients from those by image and alpha, None standing for zeros."""
    with_shape, with_colors, with_backgrounds = flags
    layout, new = layout_of(*splats.colors.shape, frame), splats.colors
    n_cameras, n, channels = new.shape
    stream = current_stream(new.device)
    capacity = saved.gaussians.untyped_storage().nbytes() // 4 - 1
    size = tiles_cuda.record_size(channels, with_shape, with_colors)
    tile_backgrounds = new.new_empty((n_cameras, layout.n_tiles // n_cameras, channels)) if with_backgrounds else None
    g_means2d = new.new_empty((n_cameras, n, 2)) if with_shape else None
    g_covars2d = torch.empty((n_cameras, n, 3), dtype=torch.float64, device=new.device) if with_shape else None
    g_opacities = new.new_empty((n_cameras, n)) if with_shape else None
    g_colors = new.new_empty((n_cameras, n, channels)) if with_colors else None
    params = _params(splats, layout, saved.lists, saved.planes) | {
        "capacity": capacity, "tile_gaussians": saved.gaussians, "pair_records": new.new_empty(capacity * size),
        "g_image": g_image, "g_alpha": g_alpha, "tile_backgrounds": tile_backgrounds, "g_means2d": g_means2d,
        "g_covars2d": g_covars2d, "g_opacities": g_opacities, "g_colors": g_colors,
        "opacities_given": n if _step(splats.opacities) == 0 else n_cameras * n,
    }  # fmt: skip
    rules = current_rules()
    backward = tiles_cuda.blend_backward(channels, layout.segments, with_shape, with_colors, rules)
    run_cuda(backward, params, layout.n_tiles, stream)
    if with_shape or with_colors:
        blocks = block_count(n_cameras * n, tiles_cuda.GATHER_BLOCK)
        run_cuda(tiles_cuda.gather(channels, with_shape, with_colors), params, blocks, stream)
    g_backgrounds = None if tile_backgrounds is None else tile_backgrounds.sum(1)
    return Gradients(g_means2d, g_covars2d, g_opacities, g_colors, g_backgrounds)
