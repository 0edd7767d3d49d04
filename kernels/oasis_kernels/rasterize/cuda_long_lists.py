"""Sort the tiles' lists that are too long for `cuda_draw`: runs in shared memory, then merges in global memory."""

import functools

from oasis_kernels.rasterize.cuda_binning import INDEX_BITS
from oasis_kernels.rasterize.cuda_draw import LONGEST
from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 256
RUN = 2048
"""Keys that are sorted in shared memory. Longer lists need spare memory to be merged in."""

SORT = """
    __shared__ long long here[@RUN@];
    const int4 own = tiles[block_index];
    const int start = own.y, count = own.z;
    if (count <= @LONGEST@) return;
    long long *from = keys + start, *to = spare + start;
    for (int first = 0; first < count; first += @RUN@) {
        const int length = min(@RUN@, count - first);
        int size = 32;
        while (size < length) size <<= 1;
        for (int k = threadIdx.x; k < size; k += @BLOCK@) here[k] = k < length ? from[first + k] : 0x7fffffffffffffffll;
        __syncthreads();
        for (int block = 2; block <= size; block <<= 1) for (int step = block >> 1; step > 0; step >>= 1) {
            for (int k = threadIdx.x; k < size / 2; k += @BLOCK@) {
                const int a = ((k & ~(step - 1)) << 1) | (k & (step - 1)), b = a + step;
                const long long u = here[a], v = here[b];
                if ((u > v) == ((a & block) == 0)) { here[a] = v; here[b] = u; }
            }
            __syncthreads();
        }
        for (int k = threadIdx.x; k < length; k += @BLOCK@) from[first + k] = here[k];
        __syncthreads();
    }
    // Without spare memory, which the host then learns from the longest list, the order stays wrong.
    if (spare) for (long long width = @RUN@; width < count; width <<= 1) {
        // Eight results a thread: how many of them and of all before come from the first run, by bisection.
        for (long long out = 8 * threadIdx.x; out < count; out += 8 * @BLOCK@) {
            const long long base = out / (2 * width) * (2 * width);
            const long long *a = from + base, n_a = min(width, count - base);
            const long long *b = a + n_a, n_b = min(width, count - base - n_a), place = out - base;
            long long low = max(0ll, place - n_b), high = min(place, n_a);
            while (low < high) {
                const long long middle = (low + high) / 2;
                if (a[middle] < b[place - 1 - middle]) low = middle + 1; else high = middle;
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
    for (int k = threadIdx.x; k < count; k += @BLOCK@)
        tile_gaussians[start + k] = camera * n + (int)(from[k] & @INDEX_MASK@);
"""


@functools.cache
def sort_long_lists() -> CudaNative:
    """Kernel: a block a tile; those with short lists have nothing to do."""
    body = SORT
    for name, number in {
        "RUN": RUN, "BLOCK": BLOCK, "LONGEST": LONGEST, "INDEX_MASK": hex((1 << INDEX_BITS) - 1),
    }.items():  # fmt: skip
        body = body.replace(f"@{name}@", str(number))
    parameters = {
        "n": "int",
        "tiles": "const int4*",
        "tiles_y": "int",
        "keys": "long long*",
        "spare": "long long*",  # as many as keys, or null
        "tile_gaussians": "int*",
    }
    return cuda_native("sort_long_lists", parameters, body, BLOCK)
