"""Lists of pairs for the tiles of the CUDA rasterizer, counted and filled in any order by atomic counters.

`count_pairs` (one thread a Gaussian) numbers the pairs of a Gaussian and a tile and counts those of each tile;
`fill_tiles` (one thread a Gaussian) writes a sorting key for each pair into its tile's list. The numbers differ from
run to run, but nothing that is drawn depends on them: a key holds depth and index, so a sorted list is the same
whatever order it was filled in, and a Gaussian's own pairs have consecutive numbers, tile after tile.
"""

import warp as wp

from oasis_kernels.tiles import tile_box

TILE = 8
"""Side of a tile [px]."""
INDEX_BITS = 24
"""Of a key, for the index of a Gaussian among those of its camera. 39 bits hold its depth: 7 of exponent, from 2^-64
to 2^63, and 32 of mantissa."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Prefix sum over the warp, then one atomic for all of it.
    const unsigned active = __activemask();
    const int lane = threadIdx.x & 31;
    int sum = count;
    for (int offset = 1; offset < 32; offset <<= 1) {
        const int other = __shfl_up_sync(active, sum, offset);
        if (lane >= offset) sum += other;
    }
    const int last = 31 - __clz(active);
    int base = 0;
    if (lane == last) base = atomicAdd(total.data, sum);
    base = __shfl_sync(active, base, last);
    return base + sum - count;
#else
    return 0;
#endif
""")
def reserve(count: int, total: wp.array(dtype=wp.int32)) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return atomicAdd(counts.data + place, 1);
#else
    return 0;
#endif
""")
def take(counts: wp.array(dtype=wp.int32), place: int) -> int: ...


@wp.func_native(f"""
    long long bits = __builtin_bit_cast(long long, depth) - (959ll << 52);
    bits = bits < 0 ? 0 : bits;
    return (bits >> 20) << {INDEX_BITS} | index;
""")
def sorting_key(depth: wp.float64, index: int) -> wp.int64: ...


@wp.kernel(enable_backward=False, module="unique")
def count_pairs(
    n: int,
    boxes: wp.array(dtype=wp.vec4i),  # [C * n]
    tiles_x: int,
    tiles_y: int,
    pair_starts: wp.array(dtype=wp.int32),  # [C * n]
    tile_counts: wp.array(dtype=wp.int32),  # zero on entry
    total: wp.array(dtype=wp.int32),  # zero on entry
):
    index = wp.tid()
    t = tile_box(boxes[index], TILE)
    image = (index // n) * tiles_y
    pair_starts[index] = reserve((t[2] - t[0]) * (t[3] - t[1]), total)
    for y in range(t[1], t[3]):
        for x in range(t[0], t[2]):
            take(tile_counts, (image + y) * tiles_x + x)


@wp.kernel(enable_backward=False, module="unique")
def fill_tiles(
    n: int,
    boxes: wp.array(dtype=wp.vec4i),
    depths: wp.array(dtype=wp.float64),
    tiles_x: int,
    tiles_y: int,
    tile_starts: wp.array(dtype=wp.int32),
    tile_cursors: wp.array(dtype=wp.int32),  # zero on entry
    keys: wp.array(dtype=wp.int64),
):
    index = wp.tid()
    t = tile_box(boxes[index], TILE)
    if t[0] >= t[2]:
        return
    image = (index // n) * tiles_y
    key = sorting_key(depths[index], index % n)
    for y in range(t[1], t[3]):
        for x in range(t[0], t[2]):
            tile = (image + y) * tiles_x + x
            keys[tile_starts[tile] + take(tile_cursors, tile)] = key
