"""Float32 blending on CUDA: a warp a tile of 8 x 8 pixels, two pixels a lane; binning without a global sort.

`count_pairs` (one thread a Gaussian) numbers the pairs of a Gaussian and a tile and counts those of each tile;
`fill_tiles` (one thread a Gaussian) writes a sorting key for each pair into its tile's list, in any order; `blend` (one
warp a tile) sorts the list in shared memory and blends it front to back; `blend_backward` replays it back to front and
leaves one record a pair, at the pair's number, for the same gather that the other kernels use.

Numbers come from atomic counters and differ from run to run, but nothing that is drawn depends on them: a key holds
depth and index, so a sorted list is the same whatever order it was filled in, and a Gaussian adds its own pairs tile
after tile. A key is 40 bits of depth (exponents from 2^-10 to 2^53, 34 bits of mantissa) above 24 bits of index.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels import constants

TILE = 8
"""Side of a tile [px]."""
LONGEST = 2048
"""Longest list that a warp sorts in shared memory."""
MAX_GAUSSIANS = 1 << 24
"""Indices that a key has room for."""


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
    const long long bits = __builtin_bit_cast(long long, depth) - (1013ll << 52);
    return ((unsigned long long)(bits >> 18) << 24) | (unsigned long long)index;
""")
def sorting_key(depth: wp.float64, index: int) -> wp.uint64: ...


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
    keys: wp.array(dtype=wp.uint64),
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
    const int lane = threadIdx.x & 31;
    const unsigned all = 0xffffffffu;
    const int camera = tile / (tiles_x * tiles_y);
    const int left = (tile % tiles_x) * 8, top = (tile / tiles_x - camera * tiles_y) * 8;
    const int start = tile_starts.data[tile], count = tile_starts.data[tile + 1] - start;
    const int px = left + (lane & 7), py0 = top + (lane >> 3), py1 = py0 + 4;
    const bool in0 = px < width && py0 < height, in1 = px < width && py1 < height;
    const long long row = (long long)camera * height;
    const long long pixel0 = (row + py0) * width + px, pixel1 = (row + py1) * width + px;
    // Offsets of the pixels' centres from the tile's corner: small, exact numbers.
    const float x = (float)(lane & 7), y0 = (float)(lane >> 3), y1 = y0 + 4.f;

    // A Gaussian as the tile sees it: centre from the tile's corner, half a pixel taken off; W scaled so that
    // alpha = 2^(lo - |W d|^2).
    struct __align__(16) Layer { float cx, cy, w0, w1, w2, w3, lo, pad; };
    auto layer = [&](int g) -> Layer {
        const float4 c = *(const float4*)(centers.data + g);
        const float4 w = *(const float4*)(whitenings.data + g);
        const float s = 0.84932180028801904f;  // sqrt(log2(e) / 2)
        return {(c.x - (float)left) + (c.z - 0.5f), (c.y - (float)top) + (c.w - 0.5f), w.x * s, w.y * s, w.z * s,
                w.w * s, log2f(opacities.data[g]), 0.f};
    };
    auto power = [](float x) -> float { float r; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r; };
"""

SORT = """
    __shared__ unsigned long long keys_of_tile[@LONGEST@];
    // A bitonic network over keys in registers: key k of the list is register k / 32 of lane k % 32.
    auto exchange = [&](unsigned long long mine, int step, bool keep_smaller) -> unsigned long long {
        const unsigned long long other = __shfl_xor_sync(all, mine, step);
        return (mine < other) == keep_smaller ? mine : other;
    };
    auto sort_registers = [&](auto registers) {
        constexpr int R = sizeof(*registers);  // a size is how a lambda can take a constant
        unsigned long long v[R];
        #pragma unroll
        for (int r = 0; r < R; r++) v[r] = r * 32 + lane < count ? keys.data[start + r * 32 + lane] : ~0ull;
        #pragma unroll
        for (int block = 2; block <= 32 * R; block <<= 1) {
            #pragma unroll
            for (int step = block >> 1; step > 0; step >>= 1) {
                if (step >= 32) {
                    #pragma unroll
                    for (int r = 0; r < R; r++) if (!(r & (step >> 5))) {
                        const int other = r | (step >> 5);
                        const bool ascending = !((r << 5) & block);
                        const unsigned long long low = v[r] < v[other] ? v[r] : v[other];
                        const unsigned long long high = v[r] < v[other] ? v[other] : v[r];
                        v[r] = ascending ? low : high;
                        v[other] = ascending ? high : low;
                    }
                } else {
                    #pragma unroll
                    for (int r = 0; r < R; r++)
                        v[r] = exchange(v[r], step, !(lane & step) == !(((r << 5) | lane) & block));
                }
            }
        }
        #pragma unroll
        for (int r = 0; r < R; r++) if (r * 32 + lane < count) keys_of_tile[r * 32 + lane] = v[r];
    };
    if (count <= 32) sort_registers((char(*)[1])nullptr);
    else if (count <= 64) sort_registers((char(*)[2])nullptr);
    else if (count <= 128) sort_registers((char(*)[4])nullptr);
    else if (count <= 256) sort_registers((char(*)[8])nullptr);
    else if (count <= 512) sort_registers((char(*)[16])nullptr);
    else {
        int size = 1024;
        while (size < count) size <<= 1;
        for (int k = lane; k < size; k += 32) keys_of_tile[k] = k < count ? keys.data[start + k] : ~0ull;
        __syncwarp();
        for (int block = 2; block <= size; block <<= 1) for (int step = block >> 1; step > 0; step >>= 1) {
            #pragma unroll 8
            for (int k = lane; k < size / 2; k += 32) {
                const int a = ((k & ~(step - 1)) << 1) | (k & (step - 1)), b = a + step;
                const unsigned long long u = keys_of_tile[a], v = keys_of_tile[b];
                const bool swap = (u > v) == ((a & block) == 0);
                keys_of_tile[a] = swap ? v : u;
                keys_of_tile[b] = swap ? u : v;
            }
            __syncwarp();
        }
    }
    __syncwarp();
"""

FORWARD = (
    SORT
    + """
    __shared__ Layer batch[32];
    __shared__ float batch_colors[32 * @CHANNELS@];
    for (int k = lane; k < count; k += 32)
        tile_gaussians.data[start + k] = camera * n + (int)(keys_of_tile[k] & 0xffffff);
    float T0 = 1.f, T1 = 1.f, A0 = 0.f, A1 = 0.f, C0[@CHANNELS@] = {}, C1[@CHANNELS@] = {};
    int stop0 = count, stop1 = count;
    bool open0 = in0, open1 = in1;
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
    for (int from = 0; from < count && __any_sync(all, open0 || open1); from += 32) {
        __syncwarp();
        if (from + lane < count) {
            const int g = camera * n + (int)(keys_of_tile[from + lane] & 0xffffff);
            batch[lane] = layer(g);
            const float* rgb = (const float*)(colors.data + g);
            for (int k = 0; k < @CHANNELS@; k++) batch_colors[lane * @CHANNELS@ + k] = rgb[k];
        } else {
            batch[lane] = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, -1e9f, 0.f};  // fainter than any cut-off
        }
        __syncwarp();
        // Four layers at a time: their alphas do not wait for each other, only the blending does.
        const int m = min(32, count - from);
        for (int j = 0; j < m; j += 4) {
            float alpha0[4], alpha1[4];
            bool any = false;
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                const Layer l = batch[j + i];
                const float dx = x - l.cx, d0 = y0 - l.cy, d1 = y1 - l.cy;
                const float u0 = l.w0 * dx + l.w1 * d0, v0 = l.w2 * dx + l.w3 * d0;
                const float u1 = l.w0 * dx + l.w1 * d1, v1 = l.w2 * dx + l.w3 * d1;
                alpha0[i] = fminf(power(l.lo - (u0 * u0 + v0 * v0)), @ALPHA_MAX@);
                alpha1[i] = fminf(power(l.lo - (u1 * u1 + v1 * v1)), @ALPHA_MAX@);
                any = any || (open0 && alpha0[i] >= @ALPHA_MIN@) || (open1 && alpha1[i] >= @ALPHA_MIN@);
            }
            if (!__any_sync(all, any)) continue;
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                const float* rgb = batch_colors + (j + i) * @CHANNELS@;
                draw(alpha0[i], from + j + i, rgb, open0, T0, A0, C0, stop0);
                draw(alpha1[i], from + j + i, rgb, open1, T1, A1, C1, stop1);
            }
        }
    }
    const float* background = (const float*)(backgrounds.data + camera);
    auto finish = [&](bool inside, long long pixel, float T, float A, const float* C, int stop) {
        if (!inside) return;
        transmittance.data[pixel] = T;
        alphas.data[pixel] = A;
        stops.data[pixel] = stop;
        float* out = (float*)(image.data + pixel);
        for (int k = 0; k < @CHANNELS@; k++) out[k] = C[k] + background[k] * T;
    };
    finish(in0, pixel0, T0, A0, C0, stop0);
    finish(in1, pixel1, T1, A1, C1, stop1);
#endif
"""
)

BACKWARD = """
    __shared__ Layer batch[32];
    __shared__ float batch_colors[32 * @CHANNELS@];
    __shared__ int batch_pairs[32];
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
    for (int k = 0; k < @CHANNELS@; k++) {
        float sum = by_background[k];
        for (int offset = 16; offset > 0; offset >>= 1) sum += __shfl_xor_sync(all, sum, offset);
        if (lane == 0) ((float*)(tile_backgrounds.data + tile))[k] = sum;
    }
    const int last = __reduce_max_sync(all, max(stop0, stop1));
    for (int place = last + lane; place < count; place += 32) {  // behind every pixel's end
        const long long pair = pair_of(tile_gaussians.data[start + place]);
        float* c = (float*)(pair_colors.data + pair);
        for (int k = 0; k < @CHANNELS@; k++) c[k] = 0.f;
        if (with_shape) for (int k = 0; k < 8; k++) ((float*)(pair_moments.data + pair))[k] = 0.f;
    }
    for (int from = (last - 1) / 32 * 32; from >= 0 && last > 0; from -= 32) {
        __syncwarp();
        if (from + lane < last) {
            const int g = tile_gaussians.data[start + from + lane];
            batch[lane] = layer(g);
            batch_pairs[lane] = pair_of(g);
            const float* rgb = (const float*)(colors.data + g);
            for (int k = 0; k < @CHANNELS@; k++) batch_colors[lane * @CHANNELS@ + k] = rgb[k];
        }
        __syncwarp();
        // As in the forward pass: four at a time, whose offsets and alphas do not wait for each other.
        for (int j = (min(32, last - from) - 1) & ~3; j >= 0; j -= 4) {
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
                    drawn[i][h] = raw[i][h] >= @ALPHA_MIN@ && from + j + i < (h ? stop1 : stop0);
                }
            }
            #pragma unroll
            for (int i = 3; i >= 0; i--) {
                if (from + j + i >= last) continue;
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


def _snippet(body: str, channels: int) -> str:
    text = HEAD + body
    values = {
        "ALPHA_MIN": constants.ALPHA_MIN, "ALPHA_MAX": constants.ALPHA_MAX, "STOP": constants.TRANSMITTANCE_STOP
    }  # fmt: skip
    for name, value in values.items():
        text = text.replace(f"@{name}@", f"{value!r}f")
    return text.replace("@CHANNELS@", str(channels)).replace("@LONGEST@", str(LONGEST))


@functools.cache
def blend(channels: int) -> Any:
    """Kernel: sort and blend the tiles; launched with (tiles, 32) threads in blocks of 32."""
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(_snippet(FORWARD, channels))
    def blend_tile(
        tile: int,
        n: int,
        tile_starts: wp.array(dtype=wp.int32),
        keys: wp.array(dtype=wp.uint64),
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
        keys: wp.array(dtype=wp.uint64),
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
            tile, n, tile_starts, keys, centers, whitenings, opacities, colors, backgrounds, tiles_x, tiles_y, width,
            height, image, alphas, transmittance, stops, tile_gaussians,
        )  # fmt: skip

    return blend


@functools.cache
def blend_backward(channels: int) -> Any:
    """Kernel: gradients by image and alpha -> one record a pair, one background gradient a tile; as `blend`."""
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    moments = wp.types.vector(length=8, dtype=wp.float32)  # of the scaled offsets; the last two are zero
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(_snippet(BACKWARD, channels))
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
