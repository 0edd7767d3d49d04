"""Blend float32 Gaussians on CUDA, a block of warps a tile."""

from typing import NamedTuple

import torch
from torch import Tensor

from oasis_kernels import cuda_binning, cuda_draw, cuda_draw_backward, cuda_long_lists
from oasis_warp.ops._launch import device_and_stream, run_cuda
from oasis_warp.ops._pair_counts import Counts, own_slot, remember, watching
from oasis_warp.ops._registration import hidden, hidden_like_fake
from oasis_warp.ops._rules import current_rules
from oasis_warp.ops._splats import Frame, Gradients, Splats, Wanted
from oasis_warp.ops._tiles import MAX_PAIRS, check_pairs

MOST_CHECKPOINTS = 1 << 16
"""Tiles times numbers a pixel up to which lists are cut into segments: beyond, there are tiles enough to fill a device,
and what is kept of the segments would outgrow the pictures."""


class Lists(NamedTuple):
    """Which Gaussians each tile draws. P pairs of a Gaussian and a tile."""

    tiles: Tensor
    """[tiles, 4], int32: column, start and length of the list, row over all cameras; tiles with any list come first."""
    pair_starts: Tensor
    """[M], int32: number of each Gaussian's first pair."""
    gaussians: Tensor
    """`hidden` [P], int32: Gaussians, nearest first; filled in where they are kept."""


class Kept(NamedTuple):
    """What the adjoint needs."""

    transmittance: Tensor
    """[C, H, W], of the end."""
    stops: Tensor
    """[C, H, W], int32: place in the tile's list of the first Gaussian that was not drawn."""
    checkpoints: Tensor
    """`hidden`, of what happens between the segments of a list: see `cuda_draw`."""
    tiles: Tensor
    """As in `Lists`, like all below."""
    pair_starts: Tensor
    gaussians: Tensor


def _count_tiles(width: int, height: int) -> tuple[int, int]:
    """Tiles across and down an image."""
    return -(-width // cuda_binning.TILE), -(-height // cuda_binning.TILE)


def _segments(n_tiles: int, channels: int) -> int:
    """Parts that the lists are cut into."""
    return cuda_draw.SEGMENTS if n_tiles * (channels + 1) <= MOST_CHECKPOINTS else 1


def _bin(splats: Splats, width: int, height: int) -> tuple[Lists, Tensor]:
    """Lists of the tiles, and the keys that short ones are to be sorted by."""
    n_cameras, n = splats.depths.shape
    device = splats.depths.device
    stream = device_and_stream(splats.depths)[1]
    across, down = _count_tiles(width, height)
    total, n_tiles = n_cameras * n, n_cameras * across * down
    counts = torch.zeros(2 * cuda_binning.COUNTERS + n_tiles, dtype=torch.int32, device=device)
    pair_starts = torch.empty(total, dtype=torch.int32, device=device)
    tiles = torch.empty((n_tiles, 4), dtype=torch.int32, device=device)
    cursors = torch.empty(n_tiles, dtype=torch.int64, device=device)
    counters = counts.data_ptr()
    tile_counts = counters + 8 * cuda_binning.COUNTERS
    scene = {"n": n, "total": total, "boxes": splats.boxes.data_ptr(), "tiles_x": across, "tiles_y": down}
    blocks = -(-total // cuda_binning.BLOCK)
    run_cuda(
        cuda_binning.count_pairs(),
        {**scene, "pair_starts": pair_starts.data_ptr(), "tile_counts": tile_counts, "counters": counters},
        blocks,
        stream,
    )
    kind = device, n_cameras, n, width, height
    capturing = torch.cuda.is_current_stream_capturing()
    report, capacity = watching().expect(kind) if capturing else (own_slot(), Counts(MAX_PAIRS, 0))
    run_cuda(
        cuda_binning.place_tiles(),
        {
            "n_tiles": n_tiles, "tiles_x": across, "tile_counts": tile_counts, "capacity": capacity.pairs, "placed": counters + 8,
            "tiles": tiles.data_ptr(), "cursors": cursors.data_ptr(), "report": report.data_ptr(),
        },
        -(-n_tiles // cuda_binning.PLACE_BLOCK),
        stream,
    )  # fmt: skip
    if not capturing:
        # The one moment at which the host waits for the device: only the data knows how much memory it takes.
        torch.cuda.current_stream(device).synchronize()
        capacity = Counts(*report[:2].tolist())
        check_pairs(capacity.pairs)
        remember(kind, capacity)
    lists = Lists(tiles, pair_starts, hidden(capacity.pairs, torch.int32, device))
    keys = torch.empty(capacity.pairs, dtype=torch.int64, device=device)
    run_cuda(
        cuda_binning.fill_tiles(),
        {
            **scene, "depths": splats.depths.data_ptr(), "capacity": capacity.pairs, "cursors": cursors.data_ptr(),
            "keys": keys.data_ptr(),
        },
        blocks,
        stream,
    )  # fmt: skip
    if capacity.longest > cuda_draw.LONGEST:
        spare = torch.empty_like(keys) if capacity.longest > cuda_long_lists.RUN else None
        run_cuda(
            cuda_long_lists.sort_long_lists(),
            {
                "n": n, "tiles": tiles.data_ptr(), "tiles_y": down, "keys": keys.data_ptr(),
                "spare": 0 if spare is None else spare.data_ptr(), "tile_gaussians": lists.gaussians.data_ptr(),
            },
            n_tiles,
            stream,
        )  # fmt: skip
    return lists, keys


def kept_like(colors: Tensor, frame: Frame) -> Kept:
    """Empty tensors of the shapes that `draw` keeps."""
    n_cameras, n, _ = colors.shape
    across, down = _count_tiles(frame.width, frame.height)

    def empty(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return colors.new_empty(shape, dtype=dtype)

    return Kept(
        empty(n_cameras, frame.height, frame.width, dtype=torch.float32),
        empty(n_cameras, frame.height, frame.width),
        hidden_like_fake(torch.float32, colors.device),
        empty(n_cameras * across * down, 4),
        empty(n_cameras * n),
        hidden_like_fake(torch.int32, colors.device),
    )


def _scene_words(splats: Splats, frame: Frame) -> tuple[dict[str, int], int]:
    """Parameters of both kernels that draw, and the number of tiles."""
    n_cameras, n, channels = splats.colors.shape
    across, down = _count_tiles(frame.width, frame.height)
    n_tiles = n_cameras * across * down
    words = {
        "n": n, "n_cameras": n_cameras, "centers": splats.centers.data_ptr(),
        "whitenings": splats.whitenings.data_ptr(), "opacities": splats.opacities.data_ptr(),
        "colors": splats.colors.data_ptr(), "backgrounds": splats.backgrounds.data_ptr(), "tiles_x": across,
        "tiles_y": down, "width": frame.width, "height": frame.height,
    }  # fmt: skip
    return words, n_tiles


def draw(splats: Splats, frame: Frame, keep: bool) -> tuple[Tensor, Tensor, Kept | None]:
    """Images over the backgrounds, alpha, and what the adjoint needs if it is to be kept.

    Raises:
        ValueError: more pairs of a Gaussian and a tile than can be numbered.
        RuntimeError: a graph captures this, and nothing is known of the number of pairs, or nobody watches it.
    """
    width, height, _ = frame
    n_cameras, _, channels = splats.colors.shape
    lists, keys = _bin(splats, width, height)
    words, n_tiles = _scene_words(splats, frame)
    segments = _segments(n_tiles, channels)
    new = splats.colors
    image, alphas = new.new_empty((n_cameras, height, width, channels)), new.new_empty((n_cameras, height, width, 1))
    kept = None
    if keep:
        between = segments - 1
        busy = min(n_tiles, lists.gaussians.untyped_storage().nbytes() // 4)  # no tile draws less than a pair
        kept = Kept(
            new.new_empty((n_cameras, height, width)),
            torch.empty((n_cameras, height, width), dtype=torch.int32, device=new.device),
            hidden(busy * between * (channels + 1) * 64, torch.float32, new.device),
            *lists,
        )
    run_cuda(
        cuda_draw.blend(channels, segments, current_rules()),
        {
            **words, "tiles": lists.tiles.data_ptr(), "keys": keys.data_ptr(),
            "tile_gaussians": lists.gaussians.data_ptr(), "image": image.data_ptr(), "alphas": alphas.data_ptr(),
            "transmittance": 0 if kept is None else kept.transmittance.data_ptr(),
            "stops": 0 if kept is None else kept.stops.data_ptr(),
            "checkpoints": 0 if kept is None else kept.checkpoints.data_ptr(),
        },
        n_tiles,
        device_and_stream(new)[1],
    )  # fmt: skip
    return image, alphas, kept


def draw_backward(
    g_image: Tensor | None, g_alpha: Tensor | None, splats: Splats, frame: Frame, kept: Kept, wanted: Wanted
) -> Gradients:
    """Gradients from those by image and alpha, None standing for zeros."""
    with_shape, with_colors, with_backgrounds = wanted
    n_cameras, n, channels = splats.colors.shape
    new, total = splats.colors, n_cameras * n
    words, n_tiles = _scene_words(splats, frame)
    stream = device_and_stream(new)[1]
    n_pairs = kept.gaussians.untyped_storage().nbytes() // 4 - 1
    size = cuda_draw_backward.record_size(channels, with_shape, with_colors)
    records = new.new_empty((n_pairs, size))
    tile_backgrounds = new.new_empty((n_cameras, n_tiles // n_cameras, channels)) if with_backgrounds else None
    backward = cuda_draw_backward.blend_backward(
        channels, _segments(n_tiles, channels), with_shape, with_colors, current_rules()
    )
    run_cuda(
        backward,
        {
            **words, "tiles": kept.tiles.data_ptr(), "tile_gaussians": kept.gaussians.data_ptr(),
            "transmittance": kept.transmittance.data_ptr(), "stops": kept.stops.data_ptr(),
            "checkpoints": kept.checkpoints.data_ptr(), "pair_starts": kept.pair_starts.data_ptr(),
            "boxes": splats.boxes.data_ptr(), "g_image": 0 if g_image is None else g_image.data_ptr(),
            "g_alpha": 0 if g_alpha is None else g_alpha.data_ptr(), "records": records.data_ptr(),
            "tile_backgrounds": 0 if tile_backgrounds is None else tile_backgrounds.data_ptr(),
        },
        n_tiles,
        stream,
    )  # fmt: skip
    g_means2d = new.new_empty((n_cameras, n, 2)) if with_shape else None
    g_covars2d = torch.empty((n_cameras, n, 3), dtype=torch.float64, device=new.device) if with_shape else None
    g_opacities = new.new_empty((n_cameras, n)) if with_shape else None
    g_colors = new.new_empty((n_cameras, n, channels)) if with_colors else None
    if with_shape or with_colors:
        gradients = {
            "g_means2d": g_means2d, "g_covars2d": g_covars2d, "g_opacities": g_opacities, "g_colors": g_colors
        }  # fmt: skip
        run_cuda(
            cuda_draw_backward.gather(channels, with_shape, with_colors),
            {
                "total": total, "capacity": n_pairs, "boxes": splats.boxes.data_ptr(),
                "pair_starts": kept.pair_starts.data_ptr(), "records": records.data_ptr(),
                "whitenings": splats.whitenings.data_ptr(), "opacities": splats.opacities.data_ptr(),
                **{name: 0 if g is None else g.data_ptr() for name, g in gradients.items()},
            },
            -(-total // cuda_draw_backward.GATHER_BLOCK),
            stream,
        )  # fmt: skip
    g_backgrounds = None if tile_backgrounds is None else tile_backgrounds.sum(1)
    return Gradients(g_means2d, g_covars2d, g_opacities, g_colors, g_backgrounds)
