"""Float32 rasterization on CUDA: a block of warps a tile of 8 x 8 pixels, two pixels a lane, no global sort.

`count_pairs` (one thread a Gaussian) numbers the pairs of a Gaussian and a tile and counts those of each tile;
`fill_tiles` (one thread a Gaussian) writes a sorting key for each pair into its tile's list, in any order; `blend` (one
block a tile) sorts the list in shared memory and blends it front to back; `blend_backward` replays it back to front and
leaves one record a pair, at the pair's number; `gather` (one thread a Gaussian) adds them up.

The longest lists decide the time, so a list is cut into segments, one a warp. A first pass over its segment tells each
warp how much light the segment lets through (and, going backward, what it shows); products over the segments in front
give the transmittance that the second pass starts with. A pixel that ends in one segment is not entered by the next.

Numbers come from atomic counters and differ from run to run, but nothing that is drawn depends on them: a key holds
depth and index, so a sorted list is the same whatever order it was filled in, segments depend on its length alone, and
a Gaussian adds its own pairs tile after tile.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels.constants import ALPHA_MAX, Rules

TILE = 8
"""Side of a tile [px]."""
WARPS = 4
"""Warps that share a tile, at most: each takes a segment of the list, of 32 layers or more."""
LONGEST = 2048
"""Longest list that is sorted in shared memory; longer ones come in sorted."""
INDEX_BITS = 24
"""Of a key, for the index of a Gaussian among those of its camera. 39 bits hold its depth: 7 of exponent, from 2^-64
to 2^63, and 32 of mantissa."""
SCALE = 0.8493218183517456
"""sqrt(log2(e) / 2) as a float32: e^(-|y|^2 / 2) = 2^(-|SCALE y|^2)."""
BLOCK = 32 * WARPS
"""Threads a tile."""


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


@wp.func_native("""
    long long bits = __builtin_bit_cast(long long, depth) - (959ll << 52);
    bits = bits < 0 ? 0 : bits;
    return (bits >> 20) << 24 | index;
""")
def sorting_key(depth: wp.float64, index: int) -> wp.int64: ...


@wp.func
def tile_box(box: wp.vec4i) -> wp.vec4i:
    """Tiles x0, y0, x1, y1 (past the end) that a box of pixels touches; empty boxes touch none."""
    if box[0] >= box[2] or box[1] >= box[3]:
        return wp.vec4i(0, 0, 0, 0)
    return wp.vec4i(box[0] // TILE, box[1] // TILE, (box[2] - 1) // TILE + 1, (box[3] - 1) // TILE + 1)


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
    t = tile_box(boxes[index])
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
    t = tile_box(boxes[index])
    if t[0] >= t[2]:
        return
    image = (index // n) * tiles_y
    key = sorting_key(depths[index], index % n)
    for y in range(t[1], t[3]):
        for x in range(t[0], t[2]):
            tile = (image + y) * tiles_x + x
            keys[tile_starts[tile] + take(tile_cursors, tile)] = key


HEAD = """
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    const unsigned all = 0xffffffffu;
    const int camera = tile / (tiles_x * tiles_y);
    const int left = (tile % tiles_x) * 8, top = (tile / tiles_x - camera * tiles_y) * 8;
    const int start = tile_starts.data[tile], count = tile_starts.data[tile + 1] - start;
    const int px = left + (lane & 7), py0 = top + (lane >> 3), py1 = py0 + 4;
    const bool in0 = px < width && py0 < height, in1 = px < width && py1 < height;
    const long long row = (long long)camera * height;
    const long long pixel0 = (row + py0) * width + px, pixel1 = (row + py1) * width + px;
    // The list is cut into equal segments, one a warp, each of 32 layers or more.
    int segments = @WARPS@;
    while (segments > 1 && count <= 32 * (segments / 2)) segments >>= 1;
    const int segment = ((count + segments - 1) / segments + 3) & ~3;
    const int from = min(warp * segment, count), to = min(from + segment, count);

    // Offsets of the pixels' centres from the tile's corner: small, exact numbers.
    const float x = (float)(lane & 7), y0 = (float)(lane >> 3), y1 = y0 + 4.f;

    // A Gaussian as the tile sees it: centre from the tile's corner, half a pixel taken off; W scaled so that
    // alpha = 2^(lo - |W d|^2).
    struct __align__(16) Layer { float cx, cy, w0, w1, w2, w3, lo, pad; };
    auto layer = [&](int g) -> Layer {
        const float4 c = *(const float4*)(centers.data + g);
        const float4 w = *(const float4*)(whitenings.data + g);
        const float s = @SCALE@;
        return {(c.x - (float)left) + (c.z - 0.5f), (c.y - (float)top) + (c.w - 0.5f), w.x * s, w.y * s, w.z * s,
                w.w * s, log2f(opacities.data[g]), 0.f};
    };
    auto power = [](float x) -> float { float r; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r; };
"""

FORWARD = """
    // One after the other, this memory holds the keys, batches of layers, and what the segments add.
    __shared__ __align__(16) float pool[@POOL@];
    __shared__ float passes[@WARPS@][64];
    Layer* batch = (Layer*)pool + 32 * warp;
    float* batch_colors = pool + 256 * @WARPS@ + 32 * @CHANNELS@ * warp;
    if (!sorted) {
        long long* sorting = (long long*)pool;  // a bitonic network
        int size = 32;
        while (size < count) size <<= 1;
        for (int k = threadIdx.x; k < size; k += blockDim.x)
            sorting[k] = k < count ? keys.data[start + k] : 0x7fffffffffffffffll;
        __syncthreads();
        for (int block = 2; block <= size; block <<= 1) for (int step = block >> 1; step > 0; step >>= 1) {
            for (int k = threadIdx.x; k < size / 2; k += blockDim.x) {
                const int a = ((k & ~(step - 1)) << 1) | (k & (step - 1)), b = a + step;
                const long long u = sorting[a], v = sorting[b];
                if ((u > v) == ((a & block) == 0)) { sorting[a] = v; sorting[b] = u; }
            }
            __syncthreads();
        }
        for (int k = threadIdx.x; k < count; k += blockDim.x)
            tile_gaussians.data[start + k] = camera * n + (int)(sorting[k] & 0xffffff);
        __syncthreads();
    }
    auto load = [&](int first, bool with_colors) {
        __syncwarp();
        const int k = first + lane;
        if (k < to) {
            const int g = tile_gaussians.data[start + k];
            batch[lane] = layer(g);
            const float* rgb = (const float*)(colors.data + g);
            if (with_colors) for (int c = 0; c < @CHANNELS@; c++) batch_colors[lane * @CHANNELS@ + c] = rgb[c];
        } else {
            batch[lane] = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, -1e9f, 0.f};  // fainter than any cut-off
            for (int c = 0; c < @CHANNELS@; c++) batch_colors[lane * @CHANNELS@ + c] = 0.f;
        }
        __syncwarp();
    };
    auto alphas_of = [&](const Layer& l, float& alpha0, float& alpha1) {
        const float dx = x - l.cx, d0 = y0 - l.cy, d1 = y1 - l.cy;
        const float u0 = l.w0 * dx + l.w1 * d0, v0 = l.w2 * dx + l.w3 * d0;
        const float u1 = l.w0 * dx + l.w1 * d1, v1 = l.w2 * dx + l.w3 * d1;
        alpha0 = fminf(power(l.lo - (u0 * u0 + v0 * v0)), @ALPHA_MAX@);
        alpha1 = fminf(power(l.lo - (u1 * u1 + v1 * v1)), @ALPHA_MAX@);
    };

    // First how much each segment lets through, whatever lies in front of it; then every segment knows the
    // transmittance that it starts with.
    float P0 = 1.f, P1 = 1.f;
    if (warp < segments - 1) for (int first = from; first < to; first += 32) {
        load(first, false);
        const int m = min(32, to - first);
        for (int j = 0; j < m; j += 4) {
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                float alpha0, alpha1;
                alphas_of(batch[j + i], alpha0, alpha1);
                P0 *= alpha0 >= @ALPHA_MIN@ ? 1.f - alpha0 : 1.f;
                P1 *= alpha1 >= @ALPHA_MIN@ ? 1.f - alpha1 : 1.f;
            }
        }
    }
    passes[warp][lane] = P0;
    passes[warp][lane + 32] = P1;
    __syncthreads();
    float T0 = 1.f, T1 = 1.f, A0 = 0.f, A1 = 0.f, C0[@CHANNELS@] = {}, C1[@CHANNELS@] = {};
    for (int k = 0; k < warp && k < segments; k++) {
        T0 *= passes[k][lane];
        T1 *= passes[k][lane + 32];
    }
    int stop0 = count, stop1 = count;
    bool open0 = in0 && T0 > @STOP@, open1 = in1 && T1 > @STOP@;
    if (!open0) stop0 = from;
    if (!open1) stop1 = from;
    auto draw = [&](float alpha, int place, const float* rgb, bool& open, float& T, float& A, float* C, int& stop) {
        const bool seen = open && alpha >= @ALPHA_MIN@;
        const float after = T * (1.f - alpha);
        const bool ends = seen && after <= @STOP@, drawn = seen && !ends;
        const float weight = drawn ? alpha * T : 0.f;
        open = open && !ends;
        stop = ends ? place : stop;
        T = drawn ? after : T;
        A += weight;
        for (int k = 0; k < @CHANNELS@; k++) C[k] += rgb[k] * weight;
    };
    if (warp < segments) for (int first = from; first < to && __any_sync(all, open0 || open1); first += 32) {
        load(first, true);
        // Four layers at a time: their alphas do not wait for each other, only the blending does.
        const int m = min(32, to - first);
        for (int j = 0; j < m; j += 4) {
            float alpha0[4], alpha1[4];
            bool any = false;
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                alphas_of(batch[j + i], alpha0[i], alpha1[i]);
                any = any || (open0 && alpha0[i] >= @ALPHA_MIN@) || (open1 && alpha1[i] >= @ALPHA_MIN@);
            }
            if (!__any_sync(all, any)) continue;
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                const float* rgb = batch_colors + (j + i) * @CHANNELS@;
                draw(alpha0[i], first + j + i, rgb, open0, T0, A0, C0, stop0);
                draw(alpha1[i], first + j + i, rgb, open1, T1, A1, C1, stop1);
            }
        }
    }

    // What the segments add, front to back. A pixel ends where the first of them says so.
    __syncthreads();  // the batches have been read
    auto sums = [&](int k, int c, int p) -> float& { return pool[(k * (@CHANNELS@ + 2) + c) * 64 + p]; };
    __shared__ int ends[@WARPS@][64];
    if (warp < segments) {
        for (int k = 0; k < @CHANNELS@; k++) { sums(warp, k, lane) = C0[k]; sums(warp, k, lane + 32) = C1[k]; }
        sums(warp, @CHANNELS@, lane) = A0; sums(warp, @CHANNELS@, lane + 32) = A1;
        sums(warp, @CHANNELS@ + 1, lane) = T0; sums(warp, @CHANNELS@ + 1, lane + 32) = T1;
        ends[warp][lane] = stop0; ends[warp][lane + 32] = stop1;
    }
    __syncthreads();
    if (warp >= 2) return;
    const int p = lane + 32 * warp;
    if (!(warp ? in1 : in0)) return;
    float A = 0.f, T = 1.f, C[@CHANNELS@] = {};
    int stop = count;
    for (int k = 0; k < segments; k++) {
        A += sums(k, @CHANNELS@, p);
        for (int c = 0; c < @CHANNELS@; c++) C[c] += sums(k, c, p);
        // A segment that was not entered (it stops where it starts) leaves the transmittance of the one before.
        if (ends[k][p] > k * segment || k == 0) T = sums(k, @CHANNELS@ + 1, p);
        if (ends[k][p] < count) { stop = ends[k][p]; break; }
    }
    const long long pixel = warp ? pixel1 : pixel0;
    const float* background = (const float*)(backgrounds.data + camera);
    transmittance.data[pixel] = T;
    alphas.data[pixel] = A;
    stops.data[pixel] = stop;
    float* out = (float*)(image.data + pixel);
    for (int k = 0; k < @CHANNELS@; k++) out[k] = C[k] + background[k] * T;
#endif
"""

BACKWARD = """
    __shared__ Layer batches[@WARPS@][32];
    __shared__ float batch_colors_of[@WARPS@][32 * @CHANNELS@];
    __shared__ int batch_pairs_of[@WARPS@][32];
    Layer* batch = batches[warp];
    float* batch_colors = batch_colors_of[warp];
    int* batch_pairs = batch_pairs_of[warp];
    auto pair_of = [&](int g) -> int {
        const int* box = (const int*)(boxes.data + g);
        const int x0 = box[0] / 8, y0 = box[1] / 8, x1 = (box[2] - 1) / 8 + 1;
        return pair_starts.data[g] + (top / 8 - y0) * (x1 - x0) + (left / 8 - x0);
    };
    // Sum of each of 8 values over the warp, by halves: lane l ends with value (l >> 2).
    auto scatter_sum = [&](float* v) -> float {
        const bool upper16 = lane & 16, upper8 = lane & 8, upper4 = lane & 4;
        for (int k = 0; k < 4; k++) {
            const float mine = upper16 ? v[k + 4] : v[k], other = upper16 ? v[k] : v[k + 4];
            v[k] = mine + __shfl_xor_sync(all, other, 16);
        }
        for (int k = 0; k < 2; k++) {
            const float mine = upper8 ? v[k + 2] : v[k], other = upper8 ? v[k] : v[k + 2];
            v[k] = mine + __shfl_xor_sync(all, other, 8);
        }
        const float mine = upper4 ? v[1] : v[0], other = upper4 ? v[0] : v[1];
        float sum = mine + __shfl_xor_sync(all, other, 4);
        sum += __shfl_xor_sync(all, sum, 2);
        return sum + __shfl_xor_sync(all, sum, 1);
    };
    float T0 = 0.f, T1 = 0.f, S0 = 0.f, S1 = 0.f, G0[@CHANNELS@] = {}, G1[@CHANNELS@] = {};
    int stop0 = 0, stop1 = 0;
    const float* background = (const float*)(backgrounds.data + camera);
    float by_background[@CHANNELS@] = {};
    auto open_pixel = [&](bool inside, long long pixel, float& T, float& S, float* G, int& stop) {
        if (!inside) return;
        T = transmittance.data[pixel];
        stop = stops.data[pixel];
        S = -g_alpha.data[pixel];
        const float* g = (const float*)(g_image.data + pixel);
        for (int k = 0; k < @CHANNELS@; k++) {
            G[k] = g[k];
            S += g[k] * background[k];
            by_background[k] += g[k] * T;
        }
    };
    open_pixel(in0, pixel0, T0, S0, G0, stop0);
    open_pixel(in1, pixel1, T1, S1, G1, stop1);
    if (warp == 0) for (int k = 0; k < @CHANNELS@; k++) {
        float sum = by_background[k];
        for (int offset = 16; offset > 0; offset >>= 1) sum += __shfl_xor_sync(all, sum, offset);
        if (lane == 0) ((float*)(tile_backgrounds.data + tile))[k] = sum;
    }
    auto load = [&](int first) {
        __syncwarp();
        if (first + lane < to) {
            const int g = tile_gaussians.data[start + first + lane];
            batch[lane] = layer(g);
            batch_pairs[lane] = pair_of(g);
            const float* rgb = (const float*)(colors.data + g);
            for (int k = 0; k < @CHANNELS@; k++) batch_colors[lane * @CHANNELS@ + k] = rgb[k];
        } else {
            batch[lane] = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, -1e9f, 0.f};
            for (int k = 0; k < @CHANNELS@; k++) batch_colors[lane * @CHANNELS@ + k] = 0.f;
        }
        __syncwarp();
    };

    // First what each segment lets through and shows by itself; then every segment knows the transmittance at its end
    // and what is seen behind it.
    __shared__ float passes[@WARPS@][64], shows[@WARPS@][64];
    float P0 = 1.f, P1 = 1.f, c0 = 0.f, c1 = 0.f;
    for (int first = from; first < to; first += 32) {
        load(first);
        const int m = min(32, to - first);
        for (int j = 0; j < m; j += 4) {
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                const Layer l = batch[j + i];
                const float* rgb = batch_colors + (j + i) * @CHANNELS@;
                const float dx = x - l.cx;
                auto pass = [&](float dy, int stop, const float* G, float& P, float& c) {
                    const float u = l.w0 * dx + l.w1 * dy, v = l.w2 * dx + l.w3 * dy;
                    const float alpha = fminf(power(l.lo - (u * u + v * v)), @ALPHA_MAX@);
                    const float a = alpha >= @ALPHA_MIN@ && first + j + i < stop ? alpha : 0.f;
                    float gc = 0.f;
                    #pragma unroll
                    for (int k = 0; k < @CHANNELS@; k++) gc += G[k] * rgb[k];
                    c += P * a * gc;
                    P *= 1.f - a;
                };
                pass(y0 - l.cy, stop0, G0, P0, c0);
                pass(y1 - l.cy, stop1, G1, P1, c1);
            }
        }
    }
    passes[warp][lane] = P0; passes[warp][lane + 32] = P1;
    shows[warp][lane] = c0; shows[warp][lane + 32] = c1;
    __syncthreads();
    if (warp >= segments) return;
    T0 = 1.f, T1 = 1.f;
    for (int k = 0; k <= warp; k++) { T0 *= passes[k][lane]; T1 *= passes[k][lane + 32]; }
    for (int k = segments - 1; k > warp; k--) {
        S0 = shows[k][lane] + passes[k][lane] * S0;
        S1 = shows[k][lane + 32] + passes[k][lane + 32] * S1;
    }
    const int last = max(from, min(to, __reduce_max_sync(all, max(stop0, stop1))));
    for (int place = last + lane; place < to; place += 32) {  // behind every pixel's end
        const long long pair = pair_of(tile_gaussians.data[start + place]);
        if (with_colors) for (int k = 0; k < @CHANNELS@; k++) ((float*)(pair_colors.data + pair))[k] = 0.f;
        if (with_shape) for (int k = 0; k < 8; k++) ((float*)(pair_moments.data + pair))[k] = 0.f;
    }
    for (int first = from + ((last - from - 1) & ~31); first >= from && last > from; first -= 32) {
        load(first);
        // As in the forward pass: four at a time, whose offsets and alphas do not wait for each other.
        for (int j = (min(32, last - first) - 1) & ~3; j >= 0; j -= 4) {
            float u[4][2], v[4][2], raw[4][2];
            bool drawn[4][2];
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                const Layer l = batch[j + i];
                const float dx = x - l.cx;
                #pragma unroll
                for (int h = 0; h < 2; h++) {
                    const float dy = (h ? y1 : y0) - l.cy;
                    u[i][h] = l.w0 * dx + l.w1 * dy;
                    v[i][h] = l.w2 * dx + l.w3 * dy;
                    raw[i][h] = power(l.lo - (u[i][h] * u[i][h] + v[i][h] * v[i][h]));
                    drawn[i][h] = raw[i][h] >= @ALPHA_MIN@ && first + j + i < (h ? stop1 : stop0);
                }
            }
            #pragma unroll
            for (int i = 3; i >= 0; i--) {
                if (first + j + i >= last) continue;
                const float* rgb = batch_colors + (j + i) * @CHANNELS@;
                const long long pair = batch_pairs[j + i];
                const bool any = __any_sync(all, drawn[i][0] || drawn[i][1]);
                float m[8] = {}, by_color[(@CHANNELS@ + 7) / 8 * 8] = {};
                auto undraw = [&](int h, float& T, float& S, const float* G) {
                    const float alpha = drawn[i][h] ? fminf(raw[i][h], @ALPHA_MAX@) : 0.f;
                    T = __fdividef(T, 1.f - alpha);
                    const float weight = alpha * T;
                    float gc = 0.f;
                    #pragma unroll
                    for (int k = 0; k < @CHANNELS@; k++) {
                        by_color[k] += G[k] * weight;
                        gc += G[k] * rgb[k];
                    }
                    const float step = gc - S;
                    S += alpha * step;
                    const float g = raw[i][h] <= @ALPHA_MAX@ ? weight * step : 0.f;
                    const float gu = drawn[i][h] ? g * u[i][h] : 0.f, gv = drawn[i][h] ? g * v[i][h] : 0.f;
                    m[0] += g;
                    m[1] += gu;
                    m[2] += gv;
                    m[3] += gu * u[i][h];
                    m[4] += gu * v[i][h];
                    m[5] += gv * v[i][h];
                };
                if (any) {
                    undraw(0, T0, S0, G0);
                    undraw(1, T1, S1, G1);
                }
                if (with_shape) {
                    const float sum = any ? scatter_sum(m) : 0.f;
                    if ((lane & 3) == 0) ((float*)(pair_moments.data + pair))[lane >> 2] = sum;
                }
                if (with_colors) {
                    #pragma unroll
                    for (int k = 0; k < @CHANNELS@; k += 8) {
                        const float sum = any ? scatter_sum(by_color + k) : 0.f;
                        if ((lane & 3) == 0 && k + (lane >> 2) < @CHANNELS@)
                            ((float*)(pair_colors.data + pair))[k + (lane >> 2)] = sum;
                    }
                }
            }
        }
    }
#endif
"""


def _snippet(body: str, channels: int, rules: Rules) -> str:
    """C++ of one block with the numbers written in, floats as literals that read back to the same number."""
    text = HEAD + body
    pool = max(2 * LONGEST, WARPS * max(256 + 32 * channels, 64 * (channels + 2)))
    for name, value in {
        "ALPHA_MIN": f"{rules.alpha_min!r}f", "ALPHA_MAX": f"{ALPHA_MAX!r}f", "STOP": f"{rules.transmittance_stop!r}f",
        "SCALE": f"{SCALE!r}f", "CHANNELS": channels, "WARPS": WARPS, "POOL": pool,
    }.items():  # fmt: skip
        text = text.replace(f"@{name}@", str(value))
    return text


@functools.cache
def blend(channels: int, rules: Rules) -> Any:
    """Kernel: sort and blend the tiles; launched with (tiles, BLOCK) threads in blocks of BLOCK."""
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(_snippet(FORWARD, channels, rules))
    def blend_tile(
        tile: int,
        n: int,
        tile_starts: wp.array(dtype=wp.int32),
        keys: wp.array(dtype=wp.int64),
        sorted: int,  # 1: `tile_gaussians` comes in filled
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        image: wp.array(dtype=color),
        alphas: wp.array(dtype=wp.float32),
        transmittance: wp.array(dtype=wp.float32),
        stops: wp.array(dtype=wp.int32),
        tile_gaussians: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def blend(
        n: int,
        tile_starts: wp.array(dtype=wp.int32),
        keys: wp.array(dtype=wp.int64),
        sorted: int,  # 1: `tile_gaussians` comes in filled
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        image: wp.array(dtype=color),
        alphas: wp.array(dtype=wp.float32),
        transmittance: wp.array(dtype=wp.float32),
        stops: wp.array(dtype=wp.int32),
        tile_gaussians: wp.array(dtype=wp.int32),
    ):
        tile, _lane = wp.tid()
        blend_tile(
            tile, n, tile_starts, keys, sorted, centers, whitenings, opacities, colors, backgrounds, tiles_x, tiles_y,
            width, height, image, alphas, transmittance, stops, tile_gaussians,
        )  # fmt: skip

    return blend


@functools.cache
def blend_backward(channels: int, rules: Rules) -> Any:
    """Kernel: gradients by image and alpha -> one record a pair, one background gradient a tile; launched as `blend`.

    A record holds sums over the tile's pixels as in `rasterize_backward`, of the scaled offset y = SCALE W d.
    """
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    moments = wp.types.vector(length=8, dtype=wp.float32)  # of the scaled offsets; the last two are zero
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(_snippet(BACKWARD, channels, rules))
    def blend_tile_backward(
        tile: int,
        tile_starts: wp.array(dtype=wp.int32),
        tile_gaussians: wp.array(dtype=wp.int32),
        pair_starts: wp.array(dtype=wp.int32),
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        transmittance: wp.array(dtype=wp.float32),
        stops: wp.array(dtype=wp.int32),
        g_image: wp.array(dtype=color),
        g_alpha: wp.array(dtype=wp.float32),
        with_shape: int,
        with_colors: int,
        pair_moments: wp.array(dtype=moments),
        pair_colors: wp.array(dtype=color),
        tile_backgrounds: wp.array(dtype=color),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def blend_backward(
        tile_starts: wp.array(dtype=wp.int32),
        tile_gaussians: wp.array(dtype=wp.int32),
        pair_starts: wp.array(dtype=wp.int32),
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        transmittance: wp.array(dtype=wp.float32),
        stops: wp.array(dtype=wp.int32),
        g_image: wp.array(dtype=color),
        g_alpha: wp.array(dtype=wp.float32),
        with_shape: int,
        with_colors: int,
        pair_moments: wp.array(dtype=moments),
        pair_colors: wp.array(dtype=color),
        tile_backgrounds: wp.array(dtype=color),
    ):
        tile, _lane = wp.tid()
        blend_tile_backward(
            tile, tile_starts, tile_gaussians, pair_starts, boxes, centers, whitenings, opacities, colors,
            backgrounds, tiles_x, tiles_y, width, height, transmittance, stops, g_image, g_alpha, with_shape,
            with_colors, pair_moments, pair_colors, tile_backgrounds,
        )  # fmt: skip

    return blend_backward


@functools.cache
def gather(channels: int) -> Any:
    """Kernel: records -> gradients by means2d, covars2d, opacities and colours; one thread a (camera, Gaussian)."""
    moments = wp.types.vector(length=8, dtype=wp.float32)
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def gather(
        boxes: wp.array(dtype=wp.vec4i),
        pair_starts: wp.array(dtype=wp.int32),
        pair_moments: wp.array(dtype=moments),
        pair_colors: wp.array(dtype=color),
        whitenings: wp.array(dtype=wp.vec4),
        opacities: wp.array(dtype=wp.float32),
        with_shape: int,
        with_colors: int,
        g_means2d: wp.array(dtype=wp.vec2),
        g_covars2d: wp.array(dtype=wp.vec3d),
        g_opacities: wp.array(dtype=wp.float32),
        g_colors: wp.array(dtype=color),
    ):
        index = wp.tid()
        t = tile_box(boxes[index])
        count = (t[2] - t[0]) * (t[3] - t[1])
        start = pair_starts[index]
        if with_colors != 0:
            total = color()
            for k in range(count):
                total += pair_colors[start + k]
            g_colors[index] = total
        if with_shape != 0:
            m = moments()
            for k in range(count):
                m += pair_moments[start + k]
            g_opacity = wp.float32(0.0)
            if count > 0:
                g_opacity = m[0] / opacities[index]
            scale = wp.float64(SCALE)
            w = wp.vec4d(whitenings[index])
            y0, y1 = wp.float64(m[1]) / scale, wp.float64(m[2]) / scale
            y00 = wp.float64(m[3]) / (scale * scale)
            y01 = wp.float64(m[4]) / (scale * scale)
            y11 = wp.float64(m[5]) / (scale * scale)
            # As in `rasterize_backward.gather_shape`.
            g_means2d[index] = wp.vec2(wp.float32(w[0] * y0 + w[2] * y1), wp.float32(w[1] * y0 + w[3] * y1))
            xx = w[0] * (w[0] * y00 + w[2] * y01) + w[2] * (w[0] * y01 + w[2] * y11)
            xy = w[1] * (w[0] * y00 + w[2] * y01) + w[3] * (w[0] * y01 + w[2] * y11)
            yy = w[1] * (w[1] * y00 + w[3] * y01) + w[3] * (w[1] * y01 + w[3] * y11)
            half = wp.float64(0.5)
            g_covars2d[index] = wp.vec3d(half * xx, xy, half * yy)
            g_opacities[index] = g_opacity

    return gather
