"""Float32 blending on CUDA: two warps sort and draw a tile of 8 x 8 pixels, one pixel a lane.

A warp goes through the tile's list 32 layers at a time: each lane fetches one and tests it against the warp's 8 x 4
pixels; those that can reach a pixel are packed together in shared memory, where all lanes read them in turn.

For the backward pass the list is cut into segments by its length alone. What each segment but the first adds to a
pixel, and the transmittance at the end of each but the last, are kept, so that the segments can be replayed at once.
"""

import functools
import math

from oasis_kernels.constants import ALPHA_MAX, CUT_SLACK, Rules
from oasis_kernels.rasterize.cuda_binning import INDEX_BITS
from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 64
"""Threads a tile."""
LONGEST = 512
"""Longest list that is sorted here; longer ones come in sorted, by `cuda_long_lists`."""
SEGMENTS = 4
"""Most parts of a list."""
SCALE = 0.8493218183517456
"""sqrt(log2(e) / 2) as a float32: e^(-|y|^2 / 2) = 2^(-|SCALE y|^2)."""

HEAD = """
    struct Layer { float cx, cy, w0, w1, w2, w3, lo; };
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    const int4 own = tiles[block_index];  // column, start and length of the list, row over all cameras
    const int start = own.y, count = own.z;
    const int camera = n_cameras == 1 ? 0 : own.w / tiles_y;
    const int left = own.x * 8, top = (own.w - camera * tiles_y) * 8;
    const long long first_pixel = ((long long)camera * height + top) * width + left;
    // Segments of the list, of 32 layers or a multiple.
    const int segment = max(32, ((count + @SEGMENTS@ - 1) / @SEGMENTS@ + 31) & ~31);
    // The memory of what is kept of this tile: by boundary between segments, number and pixel.
    float* const boundaries = checkpoints
        ? checkpoints + (long long)block_index * ((@SEGMENTS@ - 1) * (@CHANNELS@ + 1) * 64) : nullptr;
    auto boundary = [&](int b, int k, int pixel) -> float& {
        return boundaries[(b * (@CHANNELS@ + 1) + k) * 64 + pixel];
    };
    auto power = [](float x) -> float { float r; asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r; };
    auto log2_of = [](float x) -> float { float r; asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r; };
    auto inverse = [](float x) -> float { float r; asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return r; };

    // Layers of a warp, @STRIDE@ floats each: centre, W, log2 of the opacity, place in the list, colour.
    __shared__ __align__(16) float layer_memory[@WARPS@][32 * @STRIDE@];
    float* const layers = layer_memory[warp];
    const unsigned layers_at = (unsigned)__cvta_generic_to_shared(layers);
    auto load4 = [](unsigned at) -> float4 {  // of shared memory, without the arithmetic that a pointer costs
        float4 v;
        asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
                     : "=f"(v.x), "=f"(v.y), "=f"(v.z), "=f"(v.w) : "r"(at));
        return v;
    };
    auto put = [&](int slot, const Layer& l, int place, const float* color) {
        float* const to = layers + slot * @STRIDE@;
        *(float4*)to = {l.cx, l.cy, l.w0, l.w1};
        *(float4*)(to + 4) = {l.w2, l.w3, l.lo, __int_as_float(place)};
        #pragma unroll
        for (int k = 0; k < @PADDED@; k += 4)
            *(float4*)(to + 8 + k) = {color[k], k + 1 < @CHANNELS@ ? color[k + 1] : 0.f,
                                      k + 2 < @CHANNELS@ ? color[k + 2] : 0.f, k + 3 < @CHANNELS@ ? color[k + 3] : 0.f};
    };
    auto put_nothing = [&](int slot) {  // a layer that nobody sees
        float* const to = layers + slot * @STRIDE@;
        for (int k = 0; k < @STRIDE@; k++) to[k] = 0.f;
        to[6] = -1e9f;
    };

    // A Gaussian as the tile sees it: centre from the middle of the tile's first pixel, a small, exact number and a
    // remainder; W scaled so that alpha = 2^(lo - |W d|^2).
    auto layer = [&](const float4& c, const float4& w, float opacity) -> Layer {
        const float s = @SCALE@;
        return {(c.x - (float)left) + (c.z - 0.5f), (c.y - (float)top) + (c.w - 0.5f), w.x * s, w.y * s, w.z * s,
                w.w * s, log2_of(opacity)};
    };
    // Whether it can reach a pixel of the columns 0 .. 7 and the rows y_low .. y_high: the least |W d|^2 over the
    // rectangle lies at its middle or on an edge that faces the centre. The slack is larger than what rounding does.
    auto reaches = [&](const Layer& l, float y_low, float y_high) -> bool {
        const float cut = l.lo - @CUT@;
        const float x0 = -l.cx, x1 = 7.f - l.cx, y0 = y_low - l.cy, y1 = y_high - l.cy;
        const float dx = fminf(fmaxf(0.f, x0), x1), dy = fminf(fmaxf(0.f, y0), y1);
        auto fits = [&](float ex, float ey) -> bool {
            const float u = l.w0 * ex + l.w1 * ey, p = l.w2 * ex, q = l.w3 * ey;
            const float v = fmaxf(fabsf(p + q) - 1e-6f * (fabsf(p) + fabsf(q)), 0.f);
            return u * u + v * v <= cut;
        };
        const float xx = l.w0 * l.w0 + l.w2 * l.w2, yy = l.w1 * l.w1 + l.w3 * l.w3, xy = l.w0 * l.w1 + l.w2 * l.w3;
        bool any = dx == 0.f && dy == 0.f;
        if (dx != 0.f) any |= fits(dx, fminf(fmaxf(-xy * dx * inverse(yy), y0), y1));
        if (dy != 0.f) any |= fits(fminf(fmaxf(-xy * dy * inverse(xx), x0), x1), dy);
        return any && cut >= 0.f;
    };
"""

SORT = """
    // Each warp sorts 32 keys at a time in its registers; then every key counts those before it in all runs.
    __shared__ long long keys_here[@LONGEST@];
    __shared__ int sorted_here[@LONGEST@];
    if (count <= @LONGEST@) {
        const int runs = (count + 31) >> 5;
        for (int run = warp; run < runs; run += @WARPS@) {
            const int at = run * 32 + lane;
            long long key = at < count ? keys[start + at] : 0x7fffffffffffffffll;
            #pragma unroll
            for (int size = 2; size <= 32; size <<= 1) {
                #pragma unroll
                for (int step = size >> 1; step > 0; step >>= 1) {
                    const long long other = __shfl_xor_sync(all, key, step);
                    const bool smaller = ((lane & size) == 0 || size == 32) == ((lane & step) == 0);
                    if ((other < key) == smaller) key = other;
                }
            }
            keys_here[at] = key;
        }
        __syncthreads();
        for (int at = threadIdx.x; at < runs * 32; at += @BLOCK@) {
            const long long key = keys_here[at];
            int rank = 0;
            #pragma unroll 4
            for (int run = 0; run < runs; run++) {
                const long long* those = keys_here + run * 32;
                int before = 0;
                #pragma unroll
                for (int step = 16; step > 0; step >>= 1) if (those[before + step - 1] < key) before += step;
                rank += before + (those[before] < key);
            }
            if (at < count) {
                const int g = camera * n + (int)(key & @INDEX_MASK@);
                sorted_here[rank] = g;
                if (stops) tile_gaussians[start + rank] = g;
            }
        }
        __syncthreads();
    }
    const int* const list = count <= @LONGEST@ ? sorted_here : tile_gaussians + start;
"""

FORWARD = """
    const int used = (count + segment - 1) / segment;
    const int column = lane & 7, row = 4 * warp + (lane >> 3), pixel_here = row * 8 + column;
    const bool inside = left + column < width && top + row < height;
    // A pixel that has ended moves out of reach of every layer.
    float x = inside ? (float)column : 1e18f;
    const float y = (float)row, y_low = (float)(4 * warp), y_high = y_low + 3.f;
    float T = 1.f, C[@PADDED@] = {}, sums[@CHANNELS@] = {};
    int stop = count, now = 0;  // the segment being drawn
    auto keep = [&](int b, int k, float value) { if (boundaries) boundary(b, k, pixel_here) = value; };
    auto end_segment = [&]() {
        #pragma unroll
        for (int k = 0; k < @CHANNELS@; k++) {
            if (now > 0) keep(now - 1, k + 1, C[k]);
            sums[k] += C[k];
            C[k] = 0.f;
        }
        if (now < used - 1) keep(now, 0, T);
        now++;
    };

    // The next 32 layers are on their way while these are drawn.
    float4 next_center, next_whitening;
    float next_opacity, next_color[@PADDED@];
    int next_index;
    auto fetch = [&](int first) {
        if (first + lane < count) {
            next_index = list[first + lane];
            next_center = centers[next_index];
            next_whitening = whitenings[next_index];
            next_opacity = opacities[next_index];
            if (@CHANNELS@ <= 4) {
                #pragma unroll
                for (int k = 0; k < @CHANNELS@; k++) next_color[k] = colors[(long long)next_index * @CHANNELS@ + k];
            }
        }
    };
    fetch(0);
    for (int first = 0; first < count; first += 32) {
        if (first == (now + 1) * segment) end_segment();
        if (!__any_sync(all, x < 1e17f)) break;
        __syncwarp();
        const Layer l = layer(next_center, next_whitening, next_opacity);
        const bool hits = first + lane < count && reaches(l, y_low, y_high);
        const unsigned hitting = __ballot_sync(all, hits);
        const int m = __popc(hitting), slot = __popc(hitting & ((1u << lane) - 1u));
        const float* const color = @CHANNELS@ <= 4 ? next_color : colors + (long long)next_index * @CHANNELS@;
        if (hits) put(slot, l, first + lane, color);
        if (lane >= m && lane < ((m + 3) & ~3)) put_nothing(lane);
        __syncwarp();
        fetch(first + 32);
        // Four layers at a time: their alphas do not wait for each other, and the next four are under way while these
        // are blended.
        auto alphas_of = [&](int j, float* alpha) {
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                const unsigned at = layers_at + (j + i) * (4 * @STRIDE@);
                const float4 a = load4(at), b = load4(at + 16);
                const float dx = x - a.x, dy = y - a.y;
                const float u = fmaf(a.z, dx, a.w * dy), v = fmaf(b.x, dx, b.y * dy);
                const float raw = power(fmaf(-v, v, fmaf(-u, u, b.z)));
                alpha[i] = raw >= @ALPHA_MIN@ ? fminf(raw, @ALPHA_MAX@) : 0.f;
            }
        };
        float alpha[4], next_alpha[4] = {};
        if (m) alphas_of(0, alpha);
        #pragma unroll 2
        for (int j = 0; j < m; j += 4) {
            if (j + 4 < m) alphas_of(j + 4, next_alpha);
            float t[5] = {T};
            #pragma unroll
            for (int i = 0; i < 4; i++) t[i + 1] = fmaf(-alpha[i], t[i], t[i]);
            if (__any_sync(all, t[4] <= @STOP@)) {  // some pixel ends among the four
                bool ended = false;
                #pragma unroll
                for (int i = 0; i < 4; i++) {
                    if (ended) alpha[i] = 0.f;
                    t[i + 1] = fmaf(-alpha[i], t[i], t[i]);
                    if (t[i + 1] <= @STOP@) {
                        ended = true;
                        stop = __float_as_int(layers[(j + i) * @STRIDE@ + 7]);
                        x = 1e18f;
                        t[i + 1] = t[i];
                        alpha[i] = 0.f;
                    }
                }
                #pragma unroll
                for (int i = 0; i < 4; i++) if (ended) next_alpha[i] = 0.f;
            }
            #pragma unroll
            for (int i = 0; i < 4; i++) {
                const float weight = alpha[i] * t[i];
                #pragma unroll
                for (int k = 0; k < @CHANNELS@; k += 4) {
                    const float4 color = load4(layers_at + (j + i) * (4 * @STRIDE@) + 32 + 4 * k);
                    C[k] = fmaf(color.x, weight, C[k]);
                    if (k + 1 < @CHANNELS@) C[k + 1] = fmaf(color.y, weight, C[k + 1]);
                    if (k + 2 < @CHANNELS@) C[k + 2] = fmaf(color.z, weight, C[k + 2]);
                    if (k + 3 < @CHANNELS@) C[k + 3] = fmaf(color.w, weight, C[k + 3]);
                }
            }
            T = t[4];
            #pragma unroll
            for (int i = 0; i < 4; i++) alpha[i] = next_alpha[i];
        }
    }
    end_segment();
    for (; now < used; now++) {  // segments that no pixel needed
        for (int k = 0; k < @CHANNELS@; k++) keep(now - 1, k + 1, 0.f);
        if (now < used - 1) keep(now, 0, T);
    }
    if (!inside) return;
    const long long pixel = first_pixel + (long long)row * width + column;
    alphas[pixel] = 1.f - T;
    if (transmittance) transmittance[pixel] = T;
    if (stops) stops[pixel] = stop;
    #pragma unroll
    for (int k = 0; k < @CHANNELS@; k++)
        image[pixel * @CHANNELS@ + k] = sums[k] + (backgrounds ? backgrounds[camera * @CHANNELS@ + k] * T : 0.f);
"""

PARAMETERS = {
    "n": "int",
    "tiles": "const int4*",  # [tiles]: see `place_tiles`
    "n_cameras": "int",
    "centers": "const float4*",  # [C * n]
    "whitenings": "const float4*",
    "opacities": "const float*",
    "colors": "const float*",  # [C * n, channels]
    "backgrounds": "const float*",  # [C, channels], or null for black
    "tiles_x": "int",
    "tiles_y": "int",
    "width": "int",
    "height": "int",
    "tile_gaussians": "int*",  # [pairs]: the lists, nearest first; or null
    "transmittance": "float*",  # [C, H, W], or null
    "stops": "int*",  # [C, H, W]: place in the list of the first layer that was not drawn; or null
    "checkpoints": "float*",  # [tiles with pairs, segments - 1, 1 + channels, 64], or null
}
"""Parameters of both directions, and their C++ types."""


def snippet(body: str, channels: int, segments: int, rules: Rules, **numbers: int) -> str:
    """`HEAD` and `body` with the numbers written in, floats as literals that read back to the same number."""
    text, padded = HEAD + body, -(-channels // 4) * 4
    for name, value in {
        "ALPHA_MIN": f"{rules.alpha_min!r}f", "ALPHA_MAX": f"{ALPHA_MAX!r}f", "STOP": f"{rules.transmittance_stop!r}f",
        "CUT": f"({math.log2(rules.alpha_min) - CUT_SLACK!r}f)", "SCALE": f"{SCALE!r}f", "CHANNELS": channels,
        "PADDED": padded, "STRIDE": 8 + padded, "SEGMENTS": segments, "LONGEST": LONGEST,
        "INDEX_MASK": hex((1 << INDEX_BITS) - 1),
    }.items():  # fmt: skip
        text = text.replace(f"@{name}@", str(value))
    for name, number in numbers.items():
        text = text.replace(f"@{name}@", str(number))
    return text


@functools.cache
def blend(channels: int, segments: int, rules: Rules) -> CudaNative:
    """Kernel: sort and blend the tiles, a block each."""
    outputs = {"keys": "const long long*", "image": "float*", "alphas": "float*"}
    body = snippet(SORT + FORWARD, channels, segments, rules, BLOCK=BLOCK, WARPS=BLOCK // 32)
    return cuda_native(f"blend_tiles_{channels}", PARAMETERS | outputs, body, BLOCK, 10 if channels <= 4 else 4)
