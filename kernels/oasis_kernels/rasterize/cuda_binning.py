"""Lists of pairs for the tiles of the CUDA rasterizer, counted and filled in any order by atomic counters.

`count_pairs` (one thread a Gaussian) numbers the pairs of a Gaussian and a tile and counts those of each tile;
`place_tiles` (one thread a tile) gives each tile its part of the memory for lists, and puts the tiles that draw
anything first, so that they share out evenly over the device; `fill_tiles` (one thread a Gaussian) writes a sorting key
for each pair into its tile's list. All these numbers differ from run to run, but nothing that is drawn depends on them:
a key holds depth and index, so a sorted list is the same whatever order it was filled in, and a Gaussian's own pairs
have consecutive numbers, tile after tile.
"""

import functools
from typing import Any

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

TILE = 8
"""Side of a tile [px]."""
INDEX_BITS = 24
"""Of a key, for the index of a Gaussian among those of its camera. 39 bits hold its depth: 7 of exponent, from 2^-64
to 2^63, and 32 of mantissa."""
BLOCK = 128

COUNTERS = 5
"""64-bit words before the counts of the tiles: pairs numbered; then of `place_tiles` tiles with pairs << 38 | pairs,
empty tiles, longest list, blocks done. All are zero before `count_pairs` and again after `place_tiles`."""
SPREAD = 8
"""Distance of neighbouring tiles' counters in numbers: those that share 32 bytes wait for each other's atomics."""
MOST_SPREAD = 1 << 16
"""Tiles beyond which counters stand side by side: there are enough of them not to collide."""
REPORT = 2
"""64-bit words for the host: pairs, longest list."""

TILE_BOX = """
    // Tiles x0, y0, x1, y1 (past the end) that a box of pixels touches; empty boxes touch none.
    auto tile_box = [](int4 box) -> int4 {
        if (box.x >= box.z || box.y >= box.w) return {0, 0, 0, 0};
        return {box.x >> 3, box.y >> 3, ((box.z - 1) >> 3) + 1, ((box.w - 1) >> 3) + 1};
    };
"""
"""C++ for tiles of 8 pixels."""

COUNT = TILE_BOX + """
    const int4 t = thread < total ? tile_box(boxes[thread]) : int4{0, 0, 0, 0};
    const long long image = (long long)(n == total ? 0 : thread / n) * tiles_y;
    const int count = (t.z - t.x) * (t.w - t.y);
    // Prefix sum over the warp, then one atomic for all of it.
    const int lane = threadIdx.x & 31;
    long long sum = count;
    for (int offset = 1; offset < 32; offset <<= 1) {
        const long long other = __shfl_up_sync(0xffffffffu, sum, offset);
        if (lane >= offset) sum += other;
    }
    unsigned long long base = 0;
    if (lane == 31 && sum) base = atomicAdd(counters, (unsigned long long)sum);
    // Neighbours in memory are often neighbours in the image: lanes of a warp that count the same tile do it at once.
    int x = t.x, y = t.y;
    for (int done = 0; __any_sync(0xffffffffu, done < count); done++) {
        const int tile = done < count ? (int)((image + y) * tiles_x + x) : -1;
        const unsigned same = __match_any_sync(0xffffffffu, tile);
        if (tile >= 0 && lane == __ffs(same) - 1)
            atomicAdd((int*)(counters + @COUNTERS@) + (long long)tile * spread, __popc(same));
        if (++x == t.z) { x = t.x; y++; }
    }
    base = __shfl_sync(0xffffffffu, base, 31);
    if (thread < total) pair_starts[thread] = (int)(base + sum - count);
"""

PLACE = """
    __shared__ unsigned long long warp_sums[@WARPS@];
    __shared__ unsigned long long first;
    __shared__ unsigned long long first_empty;
    __shared__ int warp_longest[@WARPS@];
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    const bool inside = thread < n_tiles;
    int* const tile_counts = (int*)(counters + @COUNTERS@);
    unsigned long long* const placed = counters + 1;
    const long long own_counter = (long long)thread * spread;
    const int count = inside ? tile_counts[own_counter] : 0;
    if (inside) tile_counts[own_counter] = 0;
    // Prefix sums over the block of pairs and of tiles with pairs, in one word.
    const unsigned long long own = count ? 1ull << 38 | (unsigned long long)count : 0ull;
    unsigned long long sum = own;
    for (int offset = 1; offset < 32; offset <<= 1) {
        const unsigned long long other = __shfl_up_sync(0xffffffffu, sum, offset);
        if (lane >= offset) sum += other;
    }
    const int most = __reduce_max_sync(0xffffffffu, count);
    if (lane == 31) { warp_sums[warp] = sum; warp_longest[warp] = most; }
    __syncthreads();
    unsigned long long before = 0, all = 0;
    int longest = 0;
    for (int k = 0; k < @WARPS@; k++) {
        if (k < warp) before += warp_sums[k];
        all += warp_sums[k];
        longest = max(longest, warp_longest[k]);
    }
    const int block_first = thread - (int)threadIdx.x, block_tiles = min(@BLOCK@, n_tiles - block_first);
    if (threadIdx.x == 0) {
        first = all ? atomicAdd(placed, all) : 0ull;
        first_empty = atomicAdd(placed + 1, (unsigned long long)(block_tiles - (int)(all >> 38)));
        atomicMax((long long*)placed + 2, (long long)longest);
    }
    __syncthreads();
    if (inside) {
        const unsigned long long at = first + before + sum - own;
        const long long start = (long long)(at & ((1ull << 38) - 1));
        const int busy_before = (int)((before + sum - own) >> 38);
        const long long rank = count ? (long long)(at >> 38)
                                     : n_tiles - 1 - ((long long)first_empty + (int)threadIdx.x - busy_before);
        // A list that does not fit stays empty; the host learns of it.
        const bool fits = start + count <= capacity && count <= longest_sorted;
        const int row = thread / tiles_x;
        tiles[rank] = {thread - row * tiles_x, (int)start, fits ? count : 0, row};
        cursors[own_counter] = (int)(fits ? start : capacity);
    }
    if (threadIdx.x == 0) {
        __threadfence();
        if (atomicAdd(placed + 3, 1ull) == (n_tiles - 1) / @BLOCK@) {  // the last block: all has been added
            const unsigned long long total = atomicAdd(placed, 0ull);
            report[0] = (long long)(total & ((1ull << 38) - 1));
            report[1] = atomicMax((long long*)placed + 2, 0ll);
            for (int k = 0; k < @COUNTERS@; k++) counters[k] = 0;
        }
    }
"""

FILL = TILE_BOX + """
    const bool own = thread < total;
    const int4 t = own ? tile_box(boxes[thread]) : int4{0, 0, 0, 0};
    const int camera = n == total ? 0 : thread / n, index = thread - camera * n;
    const int count = (t.z - t.x) * (t.w - t.y), lane = threadIdx.x & 31;
    long long bits = count ? __double_as_longlong(sort_depths[thread]) - (959ll << 52) : 0;
    bits = bits < 0 ? 0 : bits;
    const long long key = (bits >> 20) << @INDEX_BITS@ | index;
    const long long image = (long long)camera * tiles_y;
    int x = t.x, y = t.y;
    for (int done = 0; __any_sync(0xffffffffu, done < count); done += 4) {
        // Four tiles at a time, whose answers are not waited for; lanes with the same tile ask once.
        int place[4];
        unsigned same[4];
        #pragma unroll
        for (int k = 0; k < 4; k++) {
            const int tile = done + k < count ? (int)((image + y) * tiles_x + x) : -1;
            same[k] = __match_any_sync(0xffffffffu, tile);
            place[k] = 0;
            if (tile >= 0 && lane == __ffs(same[k]) - 1)
                place[k] = atomicAdd(cursors + (long long)tile * spread, __popc(same[k]));
            if (++x == t.z) { x = t.x; y++; }
        }
        #pragma unroll
        for (int k = 0; k < 4; k++) {
            const unsigned at = (unsigned)__shfl_sync(0xffffffffu, place[k], __ffs(same[k]) - 1)
                + (unsigned)__popc(same[k] & ((1u << lane) - 1u));
            if (done + k < count && at < (unsigned)capacity) keys[at] = key;
        }
    }
"""

PLACE_BLOCK = 256


def spread_of(n_tiles: Any) -> int:
    """Distance of the counters of so many tiles."""
    return SPREAD if n_tiles <= MOST_SPREAD else 1


@functools.cache
def count_pairs() -> CudaNative:
    """Kernel: one thread a (camera, Gaussian)."""
    parameters = {
        "n": "int",
        "total": "int",  # cameras * n
        "boxes": "const int4*",  # [total]
        "tiles_x": "int",
        "tiles_y": "int",
        "pair_starts": "int*",  # [total]
        "spread": "int",  # see `spread_of`
        "counters": "unsigned long long*",  # [COUNTERS], and then [tiles, spread] of int
    }
    return cuda_native("count_pairs", parameters, COUNT.replace("@COUNTERS@", str(COUNTERS)), BLOCK)


@functools.cache
def place_tiles() -> CudaNative:
    """Kernel: one thread a tile."""
    parameters = {
        "n_tiles": "int",
        "tiles_x": "int",
        "capacity": "long long",  # pairs for which there is memory
        "longest_sorted": "int",  # list that will be sorted
        "counters": "unsigned long long*",
        "tiles": "int4*",  # column, start and length of the list, row over all cameras; those with pairs come first
        "spread": "int",
        "cursors": "int*",  # [tiles, spread]: the starts
        "report": "long long*",  # [REPORT]
    }
    body = PLACE
    for name, number in {"BLOCK": PLACE_BLOCK, "WARPS": PLACE_BLOCK // 32, "COUNTERS": COUNTERS}.items():
        body = body.replace(f"@{name}@", str(number))
    return cuda_native("place_tiles", parameters, body, PLACE_BLOCK)


@functools.cache
def fill_tiles() -> CudaNative:
    """Kernel: one thread a (camera, Gaussian)."""
    parameters = {
        "n": "int",
        "total": "int",
        "boxes": "const int4*",
        "sort_depths": "const double*",
        "tiles_x": "int",
        "tiles_y": "int",
        "capacity": "long long",
        "spread": "int",
        "cursors": "int*",
        "keys": "long long*",
    }
    return cuda_native("fill_tiles", parameters, FILL.replace("@INDEX_BITS@", str(INDEX_BITS)), BLOCK)
