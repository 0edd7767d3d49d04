"""Blend strip by strip with the vector kernels: float32 on the CPU.

`oasis_kernels/rasterize/strips.cpp` describes the layout.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from oasis_kernels.rasterize import strips
from oasis_warp.ops._runtime.launch import address, run_native
from oasis_warp.ops._runtime.registration import hidden, hidden_like_fake, revealed
from oasis_warp.ops._runtime.rules import current_rules
from oasis_warp.ops._runtime.splats import Frame, Gradients, Splats, Wanted
from oasis_warp.ops._runtime.tiles import check_pairs

TILES_ACROSS, TILES_DOWN = 16, 2
"""Size of a strip in tiles: 256 x 32 pixels with tiles of 16."""


class Strips(NamedTuple):
    """How pictures and Gaussians are shared out. M = cameras * Gaussians."""

    n_cameras: int
    n: int
    width: int
    height: int
    strip_width: int
    strip_height: int
    across: int
    down: int
    n_strips: int
    """Of all cameras."""
    plane: int
    """Floats of a strip's plane."""
    n_chunks: int
    chunk: int

    @property
    def words(self) -> dict[str, int]:
        """As parameters of a kernel."""
        return {
            "n": self.n_cameras * self.n, "per_camera": self.n, "n_chunks": self.n_chunks, "chunk": self.chunk,
            "width": self.width, "height": self.height, "strip_width": self.strip_width,
            "strip_height": self.strip_height, "across": self.across, "down": self.down, "n_strips": self.n_strips,
        }  # fmt: skip


def _power_of_two(at_least: int) -> int:
    return 1 << (at_least - 1).bit_length()


def cut_strips(
    n_cameras: int, n: int, width: int, height: int, tile_size: int, tiles_across: int = TILES_ACROSS
) -> Strips:
    """Strips of `tiles_across` x `TILES_DOWN` tiles, or of the image if that is less, rounded up to powers of two."""
    strip_width = _power_of_two(min(tiles_across * tile_size, max(width, strips.COLUMNS)))
    strip_height = _power_of_two(min(TILES_DOWN * tile_size, max(height, 2)))
    across, down = -(-width // strip_width), -(-height // strip_height)
    chunk = max(strips.CHUNK, -(-n_cameras * n // strips.MAX_CHUNKS))
    return Strips(
        n_cameras, n, width, height, strip_width, strip_height, across, down, n_cameras * across * down,
        strip_height * (strip_width + strips.PAD), -(-n_cameras * n // chunk), chunk,
    )  # fmt: skip


class Lists(NamedTuple):
    """Gaussians as records, and which of them each strip draws. P pairs of a Gaussian and a strip."""

    records: Tensor
    """[M, 16]; of those that are not drawn, anything."""
    starts: Tensor
    """[strips + 1]: first place of each strip's list; at the end P."""
    pair_starts: Tensor
    """[M]: number of each Gaussian's first pair."""
    order: Tensor
    """[strips]: those with long lists first."""
    ids: Tensor
    """`hidden` [P]: Gaussians, nearest first."""


class Counted(NamedTuple):
    """What `count` leaves for the kernel that fills the lists."""

    lists: Lists
    words: dict[str, int]
    n_pairs: int
    scratch: tuple[Tensor, ...]
    """Kept alive for the kernel."""


def count(splats: Splats, s: Strips) -> Counted:
    """Records, and the lengths of the strips' lists.

    Raises:
        ValueError: more pairs than can be numbered.
    """
    total, channels = s.n_cameras * s.n, splats.colors.shape[-1]
    in_record = channels if channels <= strips.RECORD_CHANNELS else 0
    records = torch.empty(total, strips.RECORD)
    starts = torch.empty(s.n_strips + 1, dtype=torch.int64)
    pair_starts = torch.empty(total, dtype=torch.int32)
    order = torch.empty(s.n_strips, dtype=torch.int32)
    counts = torch.empty(s.n_chunks * s.n_strips, dtype=torch.int32)
    by_chunk = torch.empty(3, s.n_chunks, dtype=torch.int64)
    totals = torch.empty(3, dtype=torch.int64)
    state = torch.zeros(strips.STATE, dtype=torch.int64)
    words = s.words | splats.words() | {
        "records": address(records, torch.float32, strips.RECORD * total),
        "starts": address(starts, torch.int64, s.n_strips + 1),
        "pair_starts": address(pair_starts, torch.int32, total),
        "order": address(order, torch.int32, s.n_strips),
        "state": address(state, torch.int64, strips.STATE),
        "counts": address(counts, torch.int32, s.n_chunks * s.n_strips),
        "chunk_pairs": address(by_chunk, torch.int64, 3 * s.n_chunks),
        "lows": by_chunk.data_ptr() + 8 * s.n_chunks,
        "highs": by_chunk.data_ptr() + 16 * s.n_chunks,
        "totals": address(totals, torch.int64, 3),
        "opacities": address(splats.opacities, torch.float32, total),
        "colors": address(splats.colors, torch.float32, channels * total),
    }
    run_native(strips.collect(in_record), words, s.n_chunks)
    n_pairs = int(totals[0])
    check_pairs(n_pairs)
    lists = Lists(records, starts, pair_starts, order, hidden(n_pairs, torch.int32, records.device))
    return Counted(lists, words, n_pairs, (counts, by_chunk, totals))


class Kept(NamedTuple):
    """What the adjoint needs."""

    transmittance: Tensor
    """[strips * plane], of the end, as the strips have their pixels."""
    stops: Tensor
    """[strips * plane]: place in the strip's list of the first Gaussian that was not drawn."""
    records: Tensor
    """As in `Lists`, like all below."""
    starts: Tensor
    pair_starts: Tensor
    order: Tensor
    ids: Tensor


def _strips_of(colors: Tensor, frame: Frame) -> Strips:
    return cut_strips(colors.shape[0], colors.shape[1], *frame)


def kept_like(colors: Tensor, frame: Frame) -> Kept:
    """Empty tensors of the shapes that `draw` keeps."""
    s = _strips_of(colors, frame)
    total = s.n_cameras * s.n

    def empty(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return colors.new_empty(shape, dtype=dtype)

    return Kept(
        empty(s.n_strips * s.plane, dtype=torch.float32),
        empty(s.n_strips * s.plane),
        empty(total, strips.RECORD, dtype=torch.float32),
        empty(s.n_strips + 1, dtype=torch.int64),
        empty(total),
        empty(s.n_strips),
        hidden_like_fake(torch.int32, colors.device),
    )


def draw(splats: Splats, frame: Frame, keep: bool) -> tuple[Tensor, Tensor, Kept | None]:
    """Images over the backgrounds, alpha, and what the adjoint needs if it is to be kept.

    Raises:
        ValueError: more pairs of a Gaussian and a strip than can be numbered.
    """
    s = _strips_of(splats.colors, frame)
    channels, pixels = splats.colors.shape[-1], s.n_cameras * s.height * s.width
    counted = count(splats, s)
    kept = s.n_strips * s.plane if keep else 0
    image = torch.empty(s.n_cameras, s.height, s.width, channels)
    alphas = torch.empty(s.n_cameras, s.height, s.width, 1)
    transmittance = torch.empty(kept)
    stops = torch.empty(kept, dtype=torch.int32)
    entries = torch.empty(2 * counted.n_pairs, dtype=torch.int64)
    state = torch.zeros(strips.STATE, dtype=torch.int64)
    words = counted.words | {
        "state": address(state, torch.int64, strips.STATE),
        "backgrounds": address(splats.backgrounds, torch.float32, s.n_cameras * channels),
        "entries": address(entries, torch.int64, 2 * counted.n_pairs),
        "ids": address(revealed(counted.lists.ids), torch.int32, counted.n_pairs),
        "image": address(image, torch.float32, pixels * channels),
        "alphas": address(alphas, torch.float32, pixels),
        "keep": int(keep),
        "transmittance": address(transmittance, torch.float32, kept),
        "stops": address(stops, torch.int32, kept),
    }
    run_native(strips.draw(channels, current_rules()), words, max(s.n_chunks, s.n_strips))
    return image, alphas, Kept(transmittance, stops, *counted.lists) if keep else None


def draw_backward(
    g_image: Tensor | None, g_alpha: Tensor | None, splats: Splats, frame: Frame, kept: Kept, wanted: Wanted
) -> Gradients:
    """Gradients from those by image and alpha, None standing for zeros."""
    s = _strips_of(splats.colors, frame)
    with_shape, with_colors, with_backgrounds = wanted
    channels, pixels = splats.colors.shape[-1], s.n_cameras * s.height * s.width
    total, pixels_kept = s.n_cameras * s.n, s.n_strips * s.plane
    if g_image is None:  # as with a loss on silhouettes: colours play no part, and get none
        summed = strips.Gradients(0, with_shape, False)
    else:
        summed = strips.Gradients(channels, with_shape, with_colors)
    with_strips = with_backgrounds and g_image is not None
    ids = revealed(kept.ids)
    pairs = torch.empty(len(ids) * strips.pair_words(summed))
    strip_backgrounds = torch.empty(s.n_cameras, s.across * s.down, channels if with_strips else 0)
    means2d = torch.empty(s.n_cameras, s.n if with_shape else 0, 2)
    covars2d = torch.empty(s.n_cameras, s.n if with_shape else 0, 3, dtype=torch.float64)
    opacities = torch.empty(s.n_cameras, s.n if with_shape else 0)
    colors = torch.empty(s.n_cameras, s.n if summed.color else 0, channels)
    state = torch.zeros(strips.STATE, dtype=torch.int64)
    words = s.words | splats.words() | {
        "records": address(kept.records, torch.float32, strips.RECORD * total),
        "starts": address(kept.starts, torch.int64, s.n_strips + 1),
        "pair_starts": address(kept.pair_starts, torch.int32, total),
        "order": address(kept.order, torch.int32, s.n_strips),
        "state": address(state, torch.int64, strips.STATE),
        "opacities": address(splats.opacities, torch.float32, total),
        "colors": address(splats.colors, torch.float32, total * channels),
        "backgrounds": address(splats.backgrounds, torch.float32, s.n_cameras * channels),
        "ids": address(ids, torch.int32, len(ids)),
        "transmittance": address(kept.transmittance, torch.float32, pixels_kept),
        "stops": address(kept.stops, torch.int32, pixels_kept),
        "g_image": 0 if g_image is None else address(g_image, torch.float32, pixels * channels),
        "g_alpha": 0 if g_alpha is None else address(g_alpha, torch.float32, pixels),
        "pairs": address(pairs, torch.float32, len(ids) * strips.pair_words(summed)),
        "strip_backgrounds": strip_backgrounds.data_ptr() if with_strips else 0,
        "g_means2d": address(means2d, torch.float32, 2 * total * with_shape),
        "g_covars2d": address(covars2d, torch.float64, 3 * total * with_shape),
        "g_opacities": address(opacities, torch.float32, total * with_shape),
        "g_colors": address(colors, torch.float32, channels * total * summed.color),
    }
    run_native(strips.draw_backward(summed, current_rules()), words, max(s.n_chunks, s.n_strips))
    backgrounds = strip_backgrounds.sum(1) if with_strips else torch.zeros_like(splats.backgrounds)
    if with_colors and not summed.color:
        colors = torch.zeros_like(splats.colors)
    return Gradients(
        means2d if with_shape else None,
        covars2d if with_shape else None,
        opacities if with_shape else None,
        colors if with_colors else None,
        backgrounds if with_backgrounds else None,
    )
