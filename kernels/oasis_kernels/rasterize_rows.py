"""Float32 blending on the CPU: `rasterize_forward.blend` and `rasterize_backward.blend_backward`, 16 pixels at once.

One thread a tile; arguments as in the generic kernels. A tile is kept in planes (transmittance, alpha, one a channel)
whose rows are whole vectors, so that a Gaussian that covers 7 rows of a 16-pixel tile costs 7 passes of the loop
instead of a pass for each of some 60 pixels. Lanes outside its box or below the cut-off take part with alpha 0.

The forward pass does what the generic kernel does, operation for operation and without fused multiply-adds: the same
bits. The backward pass adds a pair's pixels in another order. Clang lowers the 16-wide vectors to what the CPU has.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels import constants
from oasis_kernels.gaussian import EXP_SNIPPET

HEAD = """
    typedef float V __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    typedef float VU __attribute__((ext_vector_type(16), aligned(4)));  // rows in memory have no alignment
    auto load = [](const float* p) -> V { return *(const VU*)p; };
    auto store = [](float* p, V v) { *(VU*)p = v; };
    const V iota = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

    const int camera = tile / (tiles_x * tiles_y);
    const int left = (tile % tiles_x) * tile_size, top = (tile / tiles_x - camera * tiles_y) * tile_size;
    const int columns = wp::min(tile_size, width - left), rows = wp::min(tile_size, height - top);
    const int stride = (columns + 15) / 16 * 16;
    const long long plane = (long long)rows * stride;
    const long long start = tile_starts.data[tile];
    const int count = (int)(tile_starts.data[tile + 1] - start);
    const long long corner = ((long long)camera * height + top) * width + left;
    auto pixel_of = [&](int y, int x) -> long long { return corner + (long long)y * width + x; };

    // What all pixels of one Gaussian share; `at` gives alpha for 16 of them.
    struct Layer {
        int x0, y0, x1, y1;  // box, relative to the tile
        float whole_x, whole_y, remainder_x, remainder_y, w0, w1, w2, w3, opacity;
    };
    auto layer = [&](int g) -> Layer {
        const int* box = (const int*)(boxes.data + g);
        const float* c = (const float*)(centers.data + g);
        const float* w = (const float*)(whitenings.data + g);
        return {wp::max(box[0] - left, 0), wp::max(box[1] - top, 0), wp::min(box[2] - left, columns),
                wp::min(box[3] - top, rows), c[0], c[1], c[2], c[3], w[0], w[1], w[2], w[3], opacities.data[g]};
    };
    auto at = [&](const Layer& l, int y, int x, V& y0, V& y1, V& raw, V& alpha) -> I {
        const float dy = ((float)(top + y) - l.whole_y) + (0.5f - l.remainder_y);
        const V dx = ((iota + (float)(left + x)) - l.whole_x) + (0.5f - l.remainder_x);
        y0 = l.w0 * dx + l.w1 * dy;
        y1 = l.w2 * dx + l.w3 * dy;
        const V sigma = 0.5f * (y0 * y0 + y1 * y1);
        raw = l.opacity * exponential(sigma < 80.f ? -sigma : (V)(-80.f));  // fainter than any cut-off from there on
        alpha = raw < @ALPHA_MAX@ ? raw : (V)(@ALPHA_MAX@);
        const V column = iota + (float)x;
        return (alpha >= @ALPHA_MIN@) & (column >= (float)l.x0) & (column < (float)l.x1);
    };
"""

FORWARD = """
    float* scratch = (float*)malloc((@CHANNELS@ + 2) * plane * sizeof(float));
    float *T = scratch, *A = scratch + plane, *C = scratch + 2 * plane;
    for (long long i = 0; i < plane; i++) T[i] = 1.f;
    memset(A, 0, (@CHANNELS@ + 1) * plane * sizeof(float));
    for (int y = 0; y < rows; y++) for (int x = 0; x < columns; x++) stops.data[pixel_of(y, x)] = count;
    int open = rows * columns;

    for (int place = 0; place < count && open > 0; place++) {
        const int g = tile_gaussians.data[start + place];
        const Layer l = layer(g);
        const float* rgb = (const float*)(colors.data + g);
        for (int y = l.y0; y < l.y1; y++) for (int x = l.x0 / 16 * 16; x < l.x1; x += 16) {
            V y0, y1, raw, alpha;
            const I seen = at(l, y, x, y0, y1, raw, alpha);
            const long long i = (long long)y * stride + x;
            const V before = load(T + i);
            const I drawn = seen & (before > 0.f);
            const V a = drawn ? alpha : (V)(0.f);
            const V after = before * (1.f - a);
            const I ends = drawn & (after <= @STOP@);
            const V weight = ends ? (V)(0.f) : a * before;
            store(T + i, ends ? -before : after);
            store(A + i, load(A + i) + weight);
            for (int k = 0; k < @CHANNELS@; k++) store(C + k * plane + i, load(C + k * plane + i) + rgb[k] * weight);
            if (__builtin_reduce_or(ends)) for (int k = 0; k < 16; k++) if (ends[k]) {
                stops.data[pixel_of(y, x + k)] = place;
                open--;
            }
        }
    }

    const float* background = (const float*)(backgrounds.data + camera);
    for (int y = 0; y < rows; y++) for (int x = 0; x < columns; x++) {
        const long long i = (long long)y * stride + x, pixel = pixel_of(y, x);
        const float rest = T[i] < 0.f ? -T[i] : T[i];
        transmittance.data[pixel] = rest;
        alphas.data[pixel] = A[i];
        float* out = (float*)(image.data + pixel);
        for (int k = 0; k < @CHANNELS@; k++) out[k] = C[k * plane + i] + background[k] * rest;
    }
    free(scratch);
"""

BACKWARD = """
    typedef float H __attribute__((ext_vector_type(8)));
    typedef float Q __attribute__((ext_vector_type(4)));
    auto total = [](V v) -> float {
        const H h = v.lo + v.hi;
        const Q q = h.lo + h.hi;
        return (q.x + q.z) + (q.y + q.w);
    };
    float* scratch = (float*)malloc((@CHANNELS@ + 3) * plane * sizeof(float));
    float *T = scratch, *S = scratch + plane, *G = scratch + 3 * plane;
    int* last = (int*)(scratch + 2 * plane);
    for (long long i = 0; i < (@CHANNELS@ + 3) * plane; i++) scratch[i] = 0.f;  // lanes past the last column stay 0
    const float* background = (const float*)(backgrounds.data + camera);
    float g_background[@CHANNELS@] = {};
    for (int y = 0; y < rows; y++) for (int x = 0; x < columns; x++) {
        const long long i = (long long)y * stride + x, pixel = pixel_of(y, x);
        const float* g = (const float*)(g_image.data + pixel);
        float s = -g_alpha.data[pixel];
        T[i] = transmittance.data[pixel];
        last[i] = stops.data[pixel];
        for (int k = 0; k < @CHANNELS@; k++) {
            G[k * plane + i] = g[k];
            s += g[k] * background[k];
            g_background[k] += g[k] * T[i];
        }
        S[i] = s;
    }
    memcpy(tile_backgrounds.data + tile, g_background, sizeof g_background);

    for (int place = count - 1; place >= 0; place--) {
        const int g = tile_gaussians.data[start + place];
        const Layer l = layer(g);
        const float* rgb = (const float*)(colors.data + g);
        V m[6] = {}, g_color[@CHANNELS@] = {};
        for (int y = l.y0; y < l.y1; y++) for (int x = l.x0 / 16 * 16; x < l.x1; x += 16) {
            V y0, y1, raw, alpha;
            const I seen = at(l, y, x, y0, y1, raw, alpha);
            const long long i = (long long)y * stride + x;
            I stop;
            memcpy(&stop, last + i, sizeof stop);
            const I drawn = seen & (stop > place);
            const V a = drawn ? alpha : (V)(0.f);
            const V t = load(T + i) / (1.f - a);
            store(T + i, t);
            const V weight = a * t;
            V gc = (V)(0.f);
            for (int k = 0; k < @CHANNELS@; k++) {
                const V gk = load(G + k * plane + i);
                g_color[k] += gk * weight;
                gc += gk * rgb[k];
            }
            if (with_shape) {
                const V s = load(S + i), step = gc - s;
                store(S + i, s + a * step);
                const V v = (raw <= @ALPHA_MAX@) ? weight * step : (V)(0.f);
                y0 = drawn ? y0 : (V)(0.f);  // far outside they may be infinite
                y1 = drawn ? y1 : (V)(0.f);
                m[0] += v;
                m[1] += v * y0;
                m[2] += v * y1;
                m[3] += v * y0 * y0;
                m[4] += v * y0 * y1;
                m[5] += v * y1 * y1;
            }
        }
        const long long pair = tile_pairs.data[start + place];
        float* out = (float*)(pair_colors.data + pair);
        for (int k = 0; k < @CHANNELS@; k++) out[k] = total(g_color[k]);
        if (with_shape) {
            float* moments = (float*)(pair_moments.data + pair);
            for (int k = 0; k < 6; k++) moments[k] = total(m[k]);
        }
    }
    free(scratch);
"""


def _snippet(body: str, channels: int) -> str:
    """C++ of one tile with the constants written in, as float literals that read back to the same number."""
    text = EXP_SNIPPET.replace("@V@", "V").replace("@I@", "I")
    text = HEAD.replace("    // What all", text + "    // What all") + body
    for name, value in {
        "ALPHA_MIN": constants.ALPHA_MIN,
        "ALPHA_MAX": constants.ALPHA_MAX,
        "STOP": constants.TRANSMITTANCE_STOP,
    }.items():
        text = text.replace(f"@{name}@", f"{value!r}f")
    return text.replace("@CHANNELS@", str(channels))


@functools.cache
def blend(channels: int) -> Any:
    """Kernel: `rasterize_forward.blend` in float32 on the CPU; the second axis of the launch has size 1."""
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(_snippet(FORWARD, channels))
    def blend_tile(
        tile: int,
        tile_starts: wp.array(dtype=wp.int64),
        tile_gaussians: wp.array(dtype=wp.int32),
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        tile_size: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        image: wp.array(dtype=color),
        alphas: wp.array(dtype=wp.float32),
        transmittance: wp.array(dtype=wp.float32),
        stops: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def blend_rows(
        first: int,
        tile_starts: wp.array(dtype=wp.int64),
        tile_gaussians: wp.array(dtype=wp.int32),
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        tile_size: int,
        lane_width: int,
        lane_height: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        image: wp.array(dtype=color),
        alphas: wp.array(dtype=wp.float32),
        transmittance: wp.array(dtype=wp.float32),
        stops: wp.array(dtype=wp.int32),
    ):
        task, _lane = wp.tid()
        blend_tile(
            first + task, tile_starts, tile_gaussians, boxes, centers, whitenings, opacities, colors, backgrounds,
            tile_size, tiles_x, tiles_y, width, height, image, alphas, transmittance, stops,
        )  # fmt: skip

    return blend_rows


@functools.cache
def blend_backward(channels: int) -> Any:
    """Kernel: `rasterize_backward.blend_backward` in float32 on the CPU; leaves `transmittance` and `behind` alone."""
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    moments = wp.types.vector(length=6, dtype=wp.float32)
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(_snippet(BACKWARD, channels))
    def blend_tile_backward(
        tile: int,
        tile_starts: wp.array(dtype=wp.int64),
        tile_gaussians: wp.array(dtype=wp.int32),
        tile_pairs: wp.array(dtype=wp.int64),
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        stops: wp.array(dtype=wp.int32),
        g_image: wp.array(dtype=color),
        g_alpha: wp.array(dtype=wp.float32),
        tile_size: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        with_shape: int,
        transmittance: wp.array(dtype=wp.float32),
        pair_moments: wp.array(dtype=moments),
        pair_colors: wp.array(dtype=color),
        tile_backgrounds: wp.array(dtype=color),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def blend_rows_backward(
        first: int,
        tile_starts: wp.array(dtype=wp.int64),
        tile_gaussians: wp.array(dtype=wp.int32),
        tile_pairs: wp.array(dtype=wp.int64),
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=wp.float32),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        stops: wp.array(dtype=wp.int32),
        g_image: wp.array(dtype=color),
        g_alpha: wp.array(dtype=wp.float32),
        tile_size: int,
        lane_width: int,
        lane_height: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        with_shape: int,
        transmittance: wp.array(dtype=wp.float32),
        behind: wp.array(dtype=wp.float32),
        pair_moments: wp.array(dtype=moments),
        pair_colors: wp.array(dtype=color),
        tile_backgrounds: wp.array(dtype=color),
    ):
        task, _lane = wp.tid()
        blend_tile_backward(
            first + task, tile_starts, tile_gaussians, tile_pairs, boxes, centers, whitenings, opacities, colors,
            backgrounds, stops, g_image, g_alpha, tile_size, tiles_x, tiles_y, width, height, with_shape,
            transmittance, pair_moments, pair_colors, tile_backgrounds,
        )  # fmt: skip

    return blend_rows_backward
