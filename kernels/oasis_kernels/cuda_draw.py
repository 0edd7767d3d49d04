"""Float32 blending on CUDA: a block of warps sorts and draws a tile of 8 x 8 pixels, two pixels a lane.

The longest lists decide the time, so a list is cut into segments, one a warp, by its length alone. A first pass over
its segment tells each warp how much light the segment lets through; products over the segments in front give the
transmittance that the second pass starts with. A pixel that ends in one segment is not entered by the next.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels.constants import ALPHA_MAX, Rules
from oasis_kernels.cuda_binning import INDEX_BITS

WARPS = 4
"""Warps that share a tile, at most: each takes a segment of the list, of 32 layers or more."""
BLOCK = 32 * WARPS
"""Threads a tile."""
LONGEST = 2048
"""Longest list that is sorted in shared memory; longer ones come in sorted."""
SCALE = 0.8493218183517456
"""sqrt(log2(e) / 2) as a float32: e^(-|y|^2 / 2) = 2^(-|SCALE y|^2)."""

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
            tile_gaussians.data[start + k] = camera * n + (int)(sorting[k] & @INDEX_MASK@);
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


def snippet(body: str, channels: int, rules: Rules) -> str:
    """C++ of one block with the numbers written in, floats as literals that read back to the same number."""
    text = HEAD + body
    pool = max(2 * LONGEST, WARPS * max(256 + 32 * channels, 64 * (channels + 2)))
    for name, value in {
        "ALPHA_MIN": f"{rules.alpha_min!r}f", "ALPHA_MAX": f"{ALPHA_MAX!r}f", "STOP": f"{rules.transmittance_stop!r}f",
        "SCALE": f"{SCALE!r}f", "CHANNELS": channels, "WARPS": WARPS, "POOL": pool,
        "INDEX_MASK": hex((1 << INDEX_BITS) - 1),
    }.items():  # fmt: skip
        text = text.replace(f"@{name}@", str(value))
    return text


@functools.cache
def blend(channels: int, rules: Rules) -> Any:
    """Kernel: sort and blend the tiles; launched with (tiles, BLOCK) threads in blocks of BLOCK."""
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(snippet(FORWARD, channels, rules))
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
