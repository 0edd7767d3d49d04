"""Blend strip by strip with the vector kernels: float32 on the CPU.

`oasis_kernels/rasterize/strips.cpp` describes the layout.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_kernels.rasterize import strips
from oasis_warp.ops._runtime.blend_tiles import check_pairs, fake_opaque_buffer, opaque_buffer, opaque_elements
from oasis_warp.ops._runtime.launch import phase_state, run_native
from oasis_warp.ops._runtime.records import Frame, GradientFlags, Gradients, Splats
from oasis_warp.ops._runtime.rules import current_rules

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
    """Strips of all cameras."""
    plane: int
    """Floats of a strip's plane."""
    n_chunks: int
    chunk: int

    @property
    def params(self) -> dict[str, Any]:
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
    """Gaussians as records, and the Gaussians of each strip. P pairs of a Gaussian and a strip."""

    records: Tensor
    """[M, 16]; of those that are not drawn, anything."""
    starts: Tensor
    """[strips + 1]: first place of each strip's list; at the end P."""
    pair_starts: Tensor
    """[M]: number of each Gaussian's first pair."""
    order: Tensor
    """[strips]: those with long lists first."""
    ids: Tensor
    """`opaque_buffer` [P]: Gaussians, nearest first."""


class Counted(NamedTuple):
    """Results of `count` for the kernel that fills the lists."""

    lists: Lists
    params: dict[str, Any]
    n_pairs: int


def count(splats: Splats, s: Strips) -> Counted:
    """Records, and the lengths of the strips' lists."""
    total, channels = s.n_cameras * s.n, splats.colors.shape[-1]
    in_record = channels if channels <= strips.RECORD_CHANNELS else 0
    records = torch.empty(total, strips.RECORD)
    starts = torch.empty(s.n_strips + 1, dtype=torch.int64)
    pair_starts = torch.empty(total, dtype=torch.int32)
    order = torch.empty(s.n_strips, dtype=torch.int32)
    by_chunk = torch.empty(3, s.n_chunks, dtype=torch.int64)
    totals = torch.empty(3, dtype=torch.int64)
    params = s.params | splats.params() | {
        "records": records, "starts": starts, "pair_starts": pair_starts, "order": order,
        "state": phase_state(strips.STATE),
        "counts": torch.empty(s.n_chunks * s.n_strips, dtype=torch.int32), "chunk_pairs": by_chunk,
        "lows": by_chunk.data_ptr() + 8 * s.n_chunks, "highs": by_chunk.data_ptr() + 16 * s.n_chunks, "totals": totals,
    }  # fmt: skip
    run_native(strips.collect(in_record), params, s.n_chunks)
    n_pairs = int(totals[0])
    check_pairs(n_pairs)
    lists = Lists(records, starts, pair_starts, order, opaque_buffer(n_pairs, torch.int32, records.device))
    return Counted(lists, params, n_pairs)


class SavedTensors(NamedTuple):
    """Tensors saved for the adjoint."""

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


def fake_saved(colors: Tensor, frame: Frame) -> SavedTensors:
    """Empty tensors of the shapes that `draw` saves."""
    s = _strips_of(colors, frame)
    total = s.n_cameras * s.n

    def empty(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return colors.new_empty(shape, dtype=dtype)

    return SavedTensors(
        empty(s.n_strips * s.plane, dtype=torch.float32),
        empty(s.n_strips * s.plane),
        empty(total, strips.RECORD, dtype=torch.float32),
        empty(s.n_strips + 1, dtype=torch.int64),
        empty(total),
        empty(s.n_strips),
        fake_opaque_buffer(torch.int32, colors.device),
    )


def draw(splats: Splats, frame: Frame, keep: bool) -> tuple[Tensor, Tensor, SavedTensors | None]:
    """Images over the backgrounds, alpha, and, with `keep`, what the adjoint needs."""
    s = _strips_of(splats.colors, frame)
    channels = splats.colors.shape[-1]
    counted = count(splats, s)
    n_saved = s.n_strips * s.plane if keep else 0
    image = torch.empty(s.n_cameras, s.height, s.width, channels)
    alphas = torch.empty(s.n_cameras, s.height, s.width, 1)
    transmittance = torch.empty(n_saved)
    stops = torch.empty(n_saved, dtype=torch.int32)
    params = counted.params | {
        "state": phase_state(strips.STATE), "entries": torch.empty(2 * counted.n_pairs, dtype=torch.int64),
        "ids": opaque_elements(counted.lists.ids), "image": image, "alphas": alphas, "keep": keep,
        "transmittance": transmittance, "stops": stops,
    }  # fmt: skip
    run_native(strips.draw(channels, current_rules()), params, max(s.n_chunks, s.n_strips))
    return image, alphas, SavedTensors(transmittance, stops, *counted.lists) if keep else None


def draw_backward(
    g_image: Tensor | None, g_alpha: Tensor | None, splats: Splats, frame: Frame, saved: SavedTensors,
    flags: GradientFlags,
) -> Gradients:  # fmt: skip
    """Gradients from those by image and alpha, None standing for zeros."""
    s = _strips_of(splats.colors, frame)
    with_shape, with_colors, with_backgrounds = flags
    channels = splats.colors.shape[-1]
    if g_image is None:  # as with a loss on silhouettes: the kernel computes no gradient by colours
        summed = strips.Gradients(0, with_shape, False)
    else:
        summed = strips.Gradients(channels, with_shape, with_colors)
    with_strips = with_backgrounds and g_image is not None
    ids = opaque_elements(saved.ids)
    strip_backgrounds = torch.empty(s.n_cameras, s.across * s.down, channels if with_strips else 0)
    n_shapes = s.n if with_shape else 0
    means2d = torch.empty(s.n_cameras, n_shapes, 2)
    covars2d = torch.empty(s.n_cameras, n_shapes, 3, dtype=torch.float64)
    opacities = torch.empty(s.n_cameras, n_shapes)
    colors = torch.empty(s.n_cameras, s.n if summed.color else 0, channels)
    params = s.params | splats.params() | saved._asdict() | {
        "state": phase_state(strips.STATE), "ids": ids, "g_image": g_image, "g_alpha": g_alpha,
        "pairs": torch.empty(len(ids) * strips.pair_words(summed)), "strip_backgrounds": strip_backgrounds,
        "g_means2d": means2d, "g_covars2d": covars2d, "g_opacities": opacities, "g_colors": colors,
    }  # fmt: skip
    run_native(strips.draw_backward(summed, current_rules()), params, max(s.n_chunks, s.n_strips))
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
