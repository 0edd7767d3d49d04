// Lists of pairs for the tiles of the CUDA rasterizer, counted and filled in any order by atomic counters.
//
// `count_pairs` (one thread per Gaussian) numbers the pairs of a Gaussian and a tile and counts those of each tile;
// `place_tiles` (one thread per tile) gives each tile its part of the memory for lists, and puts the tiles that draw
// anything first, so that they share out evenly over the device; `fill_tiles` (one thread per Gaussian) writes a
// sorting key for each pair into its tile's list. All these numbers differ from run to run, but nothing that is drawn
// depends on them: a key holds depth and index, so a sorted list is the same whatever order it was filled in, and a
// Gaussian's own pairs have consecutive numbers, tile after tile.

__global__ void count_pairs(
    int n,
    int total,          // cameras * n
    const int4* boxes,  // [total]
    int tiles_x,
    int tiles_y,
    int* pair_starts,             // [total]
    int spread,                   // see `spread_of`
    unsigned long long* counters  // [COUNTERS], and then [tiles, spread] of int
) {
#include "tile_box.h"
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
            atomicAdd((int*)(counters + COUNTERS) + (long long)tile * spread, __popc(same));
        if (++x == t.z) {
            x = t.x;
            y++;
        }
    }
    base = __shfl_sync(0xffffffffu, base, 31);
    if (thread < total) pair_starts[thread] = (int)(base + sum - count);
}

__global__ void place_tiles(
    int n_tiles,
    int tiles_x,
    long long capacity,            // pairs for which there is memory
    int longest_sorted,            // list that will be sorted
    unsigned long long* counters,  // [COUNTERS], and then [tiles, spread] of int
    int4* tiles,       // column, start and length of the list, row over all cameras; those with pairs come first
    int spread,        // see `spread_of`
    int* cursors,      // [tiles, spread]: the starts
    long long* report  // [REPORT]
) {
    __shared__ unsigned long long warp_sums[WARPS];
    __shared__ unsigned long long first;
    __shared__ unsigned long long first_empty;
    __shared__ int warp_longest[WARPS];
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    const bool inside = thread < n_tiles;
    int* const tile_counts = (int*)(counters + COUNTERS);
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
    if (lane == 31) {
        warp_sums[warp] = sum;
        warp_longest[warp] = most;
    }
    __syncthreads();
    unsigned long long before = 0, all = 0;
    int longest = 0;
    for (int k = 0; k < WARPS; k++) {
        if (k < warp) before += warp_sums[k];
        all += warp_sums[k];
        longest = max(longest, warp_longest[k]);
    }
    const int block_first = thread - (int)threadIdx.x, block_tiles = min(BLOCK, n_tiles - block_first);
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
        const long long rank =
            count ? (long long)(at >> 38) : n_tiles - 1 - ((long long)first_empty + (int)threadIdx.x - busy_before);
        // A list that does not fit stays empty; the host learns of it.
        const bool fits = start + count <= capacity && count <= longest_sorted;
        const int row = thread / tiles_x;
        tiles[rank] = {thread - row * tiles_x, (int)start, fits ? count : 0, row};
        cursors[own_counter] = (int)(fits ? start : capacity);
    }
    if (threadIdx.x == 0) {
        __threadfence();
        if (atomicAdd(placed + 3, 1ull) == (n_tiles - 1) / BLOCK) {  // the last block: all has been added
            const unsigned long long total = atomicAdd(placed, 0ull);
            report[0] = (long long)(total & ((1ull << 38) - 1));
            report[1] = atomicMax((long long*)placed + 2, 0ll);
            for (int k = 0; k < COUNTERS; k++) counters[k] = 0;
        }
    }
}

__global__ void fill_tiles(
    int n,
    int total,          // cameras * n
    const int4* boxes,  // [total]
    const double* sort_depths,
    int tiles_x,
    int tiles_y,
    long long capacity,  // pairs for which there is memory
    int spread,          // see `spread_of`
    int* cursors,        // [tiles, spread]: the starts
    long long* keys
) {
#include "tile_box.h"
    const bool own = thread < total;
    const int4 t = own ? tile_box(boxes[thread]) : int4{0, 0, 0, 0};
    const int camera = n == total ? 0 : thread / n, index = thread - camera * n;
    const int count = (t.z - t.x) * (t.w - t.y), lane = threadIdx.x & 31;
    long long bits = count ? __double_as_longlong(sort_depths[thread]) - (959ll << 52) : 0;
    bits = bits < 0 ? 0 : bits;
    const long long key = (bits >> 20) << INDEX_BITS | index;
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
            if (++x == t.z) {
                x = t.x;
                y++;
            }
        }
#pragma unroll
        for (int k = 0; k < 4; k++) {
            const unsigned at = (unsigned)__shfl_sync(0xffffffffu, place[k], __ffs(same[k]) - 1) +
                                (unsigned)__popc(same[k] & ((1u << lane) - 1u));
            if (done + k < count && at < (unsigned)capacity) keys[at] = key;
        }
    }
}

// Sort the tiles' lists that are too long for `blend`: runs in shared memory, then merges in global memory.
__global__ void sort_long_lists(
    int n,
    const int4* tiles,  // column, start and length of the list, row over all cameras; those with pairs come first
    int tiles_y,
    long long* keys,
    long long* spare,  // as many as keys, or null
    int* tile_gaussians
) {
    __shared__ long long here[RUN];
    const int4 own = tiles[block_index];
    const int start = own.y, count = own.z;
    if (count <= LONGEST) return;
    long long *from = keys + start, *to = spare + start;
    for (int first = 0; first < count; first += RUN) {
        const int length = min(RUN, count - first);
        int size = 32;
        while (size < length) size <<= 1;
        for (int k = threadIdx.x; k < size; k += BLOCK) here[k] = k < length ? from[first + k] : 0x7fffffffffffffffll;
        __syncthreads();
        for (int block = 2; block <= size; block <<= 1)
            for (int step = block >> 1; step > 0; step >>= 1) {
                for (int k = threadIdx.x; k < size / 2; k += BLOCK) {
                    const int a = ((k & ~(step - 1)) << 1) | (k & (step - 1)), b = a + step;
                    const long long u = here[a], v = here[b];
                    if ((u > v) == ((a & block) == 0)) {
                        here[a] = v;
                        here[b] = u;
                    }
                }
                __syncthreads();
            }
        for (int k = threadIdx.x; k < length; k += BLOCK) from[first + k] = here[k];
        __syncthreads();
    }
    // Without spare memory, which the host then learns from the longest list, the order stays wrong.
    if (spare)
        for (long long width = RUN; width < count; width <<= 1) {
            // Eight results a thread: how many of them and of all before come from the first run, by bisection.
            for (long long out = 8 * threadIdx.x; out < count; out += 8 * BLOCK) {
                const long long base = out / (2 * width) * (2 * width);
                const long long *a = from + base, n_a = min(width, count - base);
                const long long *b = a + n_a, n_b = min(width, count - base - n_a), place = out - base;
                long long low = max(0ll, place - n_b), high = min(place, n_a);
                while (low < high) {
                    const long long middle = (low + high) / 2;
                    if (a[middle] < b[place - 1 - middle])
                        low = middle + 1;
                    else
                        high = middle;
                }
                long long i = low, j = place - low;
                for (int k = 0; k < 8 && out + k < count; k++)
                    to[out + k] = j >= n_b || (i < n_a && a[i] < b[j]) ? a[i++] : b[j++];
            }
            __syncthreads();
            long long* const swapped = from;
            from = to;
            to = swapped;
        }
    const int camera = own.w / tiles_y;
    for (int k = threadIdx.x; k < count; k += BLOCK)
        tile_gaussians[start + k] = camera * n + (int)(from[k] & INDEX_MASK);
}
