"""Adjoint of the CUDA blending: `blend_backward` replays each tile back to front, `gather` adds up its records.

Segments as in the forward pass: a first pass tells each warp how much light its segment lets through and what it shows,
products and sums over the other segments give the transmittance at its end and what is seen behind it. One record a
pair, at the pair's number; a Gaussian adds its own in order.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels.constants import Rules
from oasis_kernels.cuda_binning import TILE
from oasis_kernels.cuda_draw import SCALE, snippet
from oasis_kernels.rasterize_backward import Moments, shape_gradients
from oasis_kernels.tiles import tile_box

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


@functools.cache
def blend_backward(channels: int, rules: Rules) -> Any:
    """Kernel: gradients by image and alpha -> one record a pair, one background gradient a tile; launched as `blend`.

    A record holds sums over the tile's pixels as in `rasterize_backward`, of the scaled offset y = SCALE W d.
    """
    vec4 = wp.types.vector(length=4, dtype=wp.float32)
    moments = wp.types.vector(length=8, dtype=wp.float32)  # of the scaled offsets; the last two are zero
    color = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.func_native(snippet(BACKWARD, channels, rules))
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
        t = tile_box(boxes[index], TILE)
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
            once = wp.float64(1.0) / wp.float64(SCALE)
            twice = once * once
            sums = Moments(
                wp.float64(m[0]), once * wp.float64(m[1]), once * wp.float64(m[2]),
                twice * wp.float64(m[3]), twice * wp.float64(m[4]), twice * wp.float64(m[5]),
            )  # fmt: skip
            by_center, by_covariance = shape_gradients(wp.vec4d(whitenings[index]), sums)
            g_means2d[index] = wp.vec2(wp.float32(by_center[0]), wp.float32(by_center[1]))
            g_covars2d[index] = by_covariance
            g_opacities[index] = g_opacity

    return gather
