"""Binning and float32 blending on CUDA, tile by tile: `tile_lists.cu` and `blending.cu`."""

import functools
import math
from typing import Any

from oasis_kernels.constants import ALPHA_MAX, CUT_SLACK, Rules
from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

TILE = 8
"""Side of a tile [px]."""
INDEX_BITS = 24
"""Bits of a key for the index of a Gaussian among those of its camera. 39 bits hold its depth: 7 of exponent, from
2^-64 to 2^63, and 32 of mantissa."""
COUNTERS = 5
"""64-bit words before the counts of the tiles: pairs numbered; then of `place_tiles` tiles with pairs << 38 | pairs,
empty tiles, longest list, blocks done. All are zero before `count_pairs` and again after `place_tiles`."""
SPREAD = 8
"""Distance of neighbouring tiles' counters in numbers: those that share 32 bytes wait for each other's atomics."""
MAX_SPREAD = 1 << 16
"""Tiles beyond which counters stand side by side: there are enough of them not to collide."""
REPORT = 2
"""64-bit words for the host: pairs, longest list."""
COUNT_BLOCK = 128
"""Threads of a block of `count_pairs` and `fill_tiles`."""
PLACE_BLOCK = 256
GATHER_BLOCK = 64
LONGEST = 512
"""Longest list that `blend` sorts; longer ones come in sorted, by `sort_long_lists`."""
RUN = 2048
"""Keys that `sort_long_lists` sorts in shared memory. Longer lists need spare memory to be merged in."""
SEGMENTS = 4
"""Most parts of a list."""
SCALE = 0.8493218183517456
"""sqrt(log2(e) / 2) as a float32: e^(-|y|^2 / 2) = 2^(-|SCALE y|^2)."""
INDEX_MASK = hex((1 << INDEX_BITS) - 1)


def spread_of(n_tiles: Any) -> int:
    """Distance of the counters of so many tiles."""
    return SPREAD if n_tiles <= MAX_SPREAD else 1


def record_size(channels: int, shape: bool, colors: bool) -> int:
    """Numbers of a pair's record of gradients, a multiple of 4."""
    return -(-(6 * shape + channels * colors) // 4) * 4


@functools.cache
def count_pairs() -> CudaNative:
    """Kernel: one thread per (camera, Gaussian)."""
    return cuda_native("rasterize/tile_lists.cu", "count_pairs", COUNT_BLOCK, constants={"COUNTERS": COUNTERS})


@functools.cache
def place_tiles() -> CudaNative:
    """Kernel: one thread per tile."""
    return cuda_native("rasterize/tile_lists.cu", "place_tiles", PLACE_BLOCK, constants={"COUNTERS": COUNTERS})


@functools.cache
def fill_tiles() -> CudaNative:
    """Kernel: one thread per (camera, Gaussian)."""
    return cuda_native("rasterize/tile_lists.cu", "fill_tiles", COUNT_BLOCK, constants={"INDEX_BITS": INDEX_BITS})


@functools.cache
def sort_long_lists() -> CudaNative:
    """Kernel: one block per tile; those with short lists have nothing to do."""
    constants = {"RUN": RUN, "LONGEST": LONGEST, "INDEX_MASK": INDEX_MASK}
    return cuda_native("rasterize/tile_lists.cu", "sort_long_lists", 256, constants=constants)


def _constants(channels: int, segments: int, rules: Rules) -> dict[str, object]:
    """What `tile_layers.h` sees; floats as literals that read back to the same number."""
    padded = -(-channels // 4) * 4
    return {
        "ALPHA_MIN": f"{rules.alpha_min!r}f", "ALPHA_MAX": f"{ALPHA_MAX!r}f", "STOP": f"{rules.transmittance_stop!r}f",
        "CUT": f"({math.log2(rules.alpha_min) - CUT_SLACK!r}f)", "SCALE": f"{SCALE!r}f", "CHANNELS": channels,
        "PADDED": padded, "STRIDE": 8 + padded, "SEGMENTS": segments, "LONGEST": LONGEST, "INDEX_MASK": INDEX_MASK,
    }  # fmt: skip


@functools.cache
def blend(channels: int, segments: int, rules: Rules) -> CudaNative:
    """Kernel: sort and blend the tiles, a block each."""
    return cuda_native(
        "rasterize/blending.cu", "blend", 64, blocks_per_multiprocessor=10 if channels <= 4 else 4,
        label=f"blend_tiles_{channels}", constants=_constants(channels, segments, rules),
    )  # fmt: skip


@functools.cache
def blend_backward(channels: int, segments: int, shape: bool, colors: bool, rules: Rules) -> CudaNative:
    """Kernel: gradients by image and alpha -> one record per pair, one background gradient per tile; a block a tile."""
    numbers = {
        "SHAPE": int(shape), "COLORS": int(colors), "VALUES": 6 * shape + channels * colors,
        "RECORD": record_size(channels, shape, colors),
    }  # fmt: skip
    return cuda_native(
        "rasterize/blending_backward.cu", "blend_backward", 32 * segments,
        blocks_per_multiprocessor=16 // segments if channels <= 4 else 1, label=f"blend_tiles_backward_{channels}",
        constants=_constants(channels, segments, rules) | numbers,
    )  # fmt: skip


@functools.cache
def gather(channels: int, shape: bool, colors: bool) -> CudaNative:
    """Kernel: records -> gradients by means2d, covars2d, opacities and colours; one thread per (camera, Gaussian)."""
    constants = {
        "CHANNELS": channels, "SHAPE": int(shape), "COLORS": int(colors), "SCALE": SCALE,
        "RECORD": record_size(channels, shape, colors),
    }  # fmt: skip
    return cuda_native("rasterize/blending_backward.cu", "gather", GATHER_BLOCK, label=f"gather_records_{channels}",
                       constants=constants)  # fmt: skip
