// Adjoint of the CUDA blending: `blend_backward` replays each tile back to front, `gather` adds up its records.
//
// A warp replays a segment of the list for all 64 pixels, two a lane. What the forward pass kept tells it the
// transmittance at the segment's end and what the later segments add, and so what is seen behind it. One record per
// pair, at the pair's number; a Gaussian adds its own in order. Records hold sums over the tile's pixels as in
// `rasterize_backward`, of the scaled offset y = SCALE W d: six by the shape, then one a channel.
__global__ void blend_backward(
#include "tile_parameters.inc"
    const int* pair_starts,  // [C * n]
    const int4* boxes,
    const float* g_image,    // [C, H, W, channels], or null for zeros
    const float* g_alpha,    // [C, H, W], or null for zeros
    float* pair_records,     // [pairs, record size]
    float* tile_backgrounds  // [tiles, channels], or null
) {
#include "tile_layers.h"
#include "tile_box.h"
    __shared__ float* records_of[WARPS][32];
    float** const layer_records = records_of[warp];
    if (warp * segment >= count && (warp > 0 || !tile_backgrounds)) return;
    const int used = (count + segment - 1) / segment;

    // Sums over the warp of each of 32 values, by halves: lane l ends with value l.
    auto fold = [&](float mine, float other, bool upper, int distance) -> float {
        return (upper ? other : mine) + __shfl_xor_sync(all, upper ? mine : other, distance);
    };
    auto scatter_sum = [&](float* v) -> float {
        const bool upper16 = lane & 16, upper8 = lane & 8, upper4 = lane & 4, upper2 = lane & 2, upper1 = lane & 1;
#pragma unroll
        for (int k = 0; k < 16; k++) v[k] = fold(v[k], v[k + 16], upper16, 16);
#pragma unroll
        for (int k = 0; k < 8; k++) v[k] = fold(v[k], v[k + 8], upper8, 8);
#pragma unroll
        for (int k = 0; k < 4; k++) v[k] = fold(v[k], v[k + 4], upper4, 4);
        v[0] = fold(v[0], v[2], upper2, 2);
        v[1] = fold(v[1], v[3], upper2, 2);
        return fold(v[0], v[1], upper1, 1);
    };
    // The same of 4 values: lane l ends with value l >> 3.
    auto scatter_sum_4 = [&](const float* v) -> float {
        const bool upper16 = lane & 16, upper8 = lane & 8;
        float sum = fold(fold(v[0], v[2], upper16, 16), fold(v[1], v[3], upper16, 16), upper8, 8);
#pragma unroll
        for (int offset = 4; offset > 0; offset >>= 1) sum += __shfl_xor_sync(all, sum, offset);
        return sum;
    };
    auto sum_lanes = [&](float sum) -> float {
#pragma unroll
        for (int offset = 16; offset > 0; offset >>= 1) sum += __shfl_xor_sync(all, sum, offset);
        return sum;
    };

    const float x = (float)(lane & 7), y[2] = {(float)(lane >> 3), (float)(lane >> 3) + 4.f};
    float T[2] = {1.f, 1.f}, S[2] = {}, G[2][CHANNELS] = {};  // S: what is seen behind, times G
    int stop[2] = {};
    float by_background[CHANNELS] = {};
#pragma unroll
    for (int h = 0; h < 2; h++) {
        const int row = (lane >> 3) + 4 * h;
        if (left + (lane & 7) >= width || top + row >= height) continue;
        const long long pixel = first_pixel + (long long)row * width + (lane & 7);
        const float final_T = transmittance[pixel];
        stop[h] = stops[pixel];
        float behind = g_alpha ? -g_alpha[pixel] : 0.f;
#pragma unroll
        for (int k = 0; k < CHANNELS; k++) {
            G[h][k] = g_image ? g_image[pixel * CHANNELS + k] : 0.f;
            if (backgrounds) behind += G[h][k] * backgrounds[camera * CHANNELS + k];
            by_background[k] += G[h][k] * final_T;
        }
        T[h] = final_T;
        S[h] = behind;
        if (warp < used - 1) {
            T[h] = boundary(warp, 0, row * 8 + (lane & 7));
            S[h] *= final_T;
            for (int b = used - 2; b >= warp; b--) {
#pragma unroll
                for (int k = 0; k < CHANNELS; k++) S[h] += G[h][k] * boundary(b, k + 1, row * 8 + (lane & 7));
            }
            S[h] *= inverse(T[h]);
        }
    }
    if (tile_backgrounds && warp == 0) {
#pragma unroll
        for (int k = 0; k < CHANNELS; k++) {
            const float sum = sum_lanes(by_background[k]);
            if (lane == 0) tile_backgrounds[((long long)own.w * tiles_x + own.x) * CHANNELS + k] = sum;
        }
    }

    const int* const list = tile_gaussians + start;
    const int from = warp * segment, to = min(from + segment, count);
    const int last = __reduce_max_sync(all, max(stop[0], stop[1]));
    if (RECORD)
        for (int first = from + ((to - from - 1) & ~31); first >= from; first -= 32) {
            __syncwarp();
            Layer l;
            int g;
            float* record = nullptr;
            bool hits = false;
            if (first + lane < to) {
                g = list[first + lane];
                const int4 t = tile_box(boxes[g]);
                const int number = pair_starts[g] + (top / 8 - t.y) * (t.z - t.x) + left / 8 - t.x;
                record = pair_records + (long long)number * RECORD;
                l = layer(centers[g], whitenings[g], own_opacities[g]);
                hits = first + lane < last && reaches(l, 0.f, 7.f);
                if (!hits) {
#pragma unroll
                    for (int k = 0; k < RECORD; k += 4) *(float4*)(record + k) = {0.f, 0.f, 0.f, 0.f};
                }
            }
            const unsigned hitting = __ballot_sync(all, hits);
            const int m = __popc(hitting), slot = __popc(hitting & ((1u << lane) - 1u));
            if (hits) {
                put(slot, l, first + lane, own_colors + (long long)g * CHANNELS);
                layer_records[slot] = record;
            }
            if (lane >= m && lane < ((m + 3) & ~3)) put_nothing(lane);
            __syncwarp();
            // Four layers at a time: most of what they take does not wait for each other, and their sums share
            // shuffles.
            for (int j = (m - 1) & ~3; j >= 0; j -= 4) {
                float u[4][2], v[4][2], weight[4][2], by_alpha[4][2];
#pragma unroll
                for (int i = 0; i < 4; i++) {
                    const unsigned at = layers_at + (j + i) * (4 * STRIDE);
                    const float4 a = load4(at), b = load4(at + 16);
                    const float dx = x - a.x;
#pragma unroll
                    for (int h = 0; h < 2; h++) {
                        const float dy = y[h] - a.y;
                        u[i][h] = fmaf(a.z, dx, a.w * dy);
                        v[i][h] = fmaf(b.x, dx, b.y * dy);
                        const float raw = power(fmaf(-v[i][h], v[i][h], fmaf(-u[i][h], u[i][h], b.z)));
                        by_alpha[i][h] = raw >= ALPHA_MIN && __float_as_int(b.w) < stop[h] ? raw : 0.f;
                    }
                }
#pragma unroll
                for (int i = 3; i >= 0; i--) {
                    float color[PADDED];
#pragma unroll
                    for (int k = 0; k < PADDED; k += 4) {
                        const float4 four = load4(layers_at + (j + i) * (4 * STRIDE) + 32 + 4 * k);
                        color[k] = four.x;
                        color[k + 1] = four.y;
                        color[k + 2] = four.z;
                        color[k + 3] = four.w;
                    }
#pragma unroll
                    for (int h = 0; h < 2; h++) {
                        const float raw = by_alpha[i][h], alpha = fminf(raw, ALPHA_MAX);
                        T[h] *= inverse(1.f - alpha);
                        weight[i][h] = alpha * T[h];
                        float gc = 0.f;
#pragma unroll
                        for (int k = 0; k < CHANNELS; k++) gc = fmaf(G[h][k], color[k], gc);
                        const float step = gc - S[h];
                        S[h] = fmaf(alpha, step, S[h]);
                        by_alpha[i][h] = raw <= ALPHA_MAX ? weight[i][h] * step : 0.f;
                    }
                }
                auto value = [&](int i, int k) -> float {  // number k of the record of layer i, of this lane's pixels
                    float sum = 0.f;
#pragma unroll
                    for (int h = 0; h < 2; h++) {
                        const float a = u[i][h], b = v[i][h], g = by_alpha[i][h];
                        if (SHAPE && k < 6)
                            sum += k == 0   ? g
                                   : k == 1 ? g * a
                                   : k == 2 ? g * b
                                   : k == 3 ? g * a * a
                                   : k == 4 ? g * a * b
                                            : g * b * b;
                        else if (COLORS && k - 6 * SHAPE < CHANNELS)
                            sum += G[h][k - 6 * SHAPE] * weight[i][h];
                    }
                    return sum;
                };
                const int mine = j + (lane >> 3);
                float* const to = mine < m ? layer_records[mine] : nullptr;
#pragma unroll
                for (int first_value = 0; first_value + 2 <= VALUES; first_value += 8) {
                    float values[32];
#pragma unroll
                    for (int k = 0; k < 32; k++) values[k] = value(k >> 3, first_value + (k & 7));
                    const float sum = scatter_sum(values);
                    if (to && first_value + (lane & 7) < RECORD) to[first_value + (lane & 7)] = sum;
                }
                if (VALUES % 8 == 1) {
                    float values[4];
#pragma unroll
                    for (int k = 0; k < 4; k++) values[k] = value(k, VALUES - 1);
                    const float sum = scatter_sum_4(values);
                    if (to && (lane & 7) == 0) to[VALUES - 1] = sum;
                }
            }
        }
}

__global__ void gather(
    int total,
    long long capacity,  // pairs for which there are records
    const int4* boxes,
    const int* pair_starts,     // [C * n]
    const float* pair_records,  // [pairs, record size]
    const float4* whitenings,
    const float* opacities,  // [total], or [opacities_given] for each camera in turn
    int opacities_given,
    float2* g_means2d,
    double* g_covars2d,
    float* g_opacities,
    float* g_colors
) {
#include "tile_box.h"
    if (thread >= total) return;
    const int4 t = tile_box(boxes[thread]);
    const int count = (t.z - t.x) * (t.w - t.y);
    const long long start = pair_starts[thread];
    float sums[RECORD] = {};
    if (start + count <= capacity)
        for (int pair = 0; pair < count; pair++) {
            const float4* record = (const float4*)(pair_records + (start + pair) * RECORD);
#pragma unroll
            for (int k = 0; k < RECORD / 4; k++) {
                const float4 four = record[k];
                sums[4 * k] += four.x;
                sums[4 * k + 1] += four.y;
                sums[4 * k + 2] += four.z;
                sums[4 * k + 3] += four.w;
            }
        }
    if (COLORS) {
#pragma unroll
        for (int k = 0; k < CHANNELS; k++) g_colors[(long long)thread * CHANNELS + k] = sums[6 * SHAPE + k];
    }
    if (SHAPE) {
        const float4 whitening = whitenings[thread];
        const double w0 = whitening.x, w1 = whitening.y, w2 = whitening.z, w3 = whitening.w;
        const double once = 1.0 / SCALE, twice = once * once;
        const double m1 = once * sums[1], m2 = once * sums[2];
        const double m3 = twice * sums[3], m4 = twice * sums[4], m5 = twice * sums[5];
        g_means2d[thread] = {(float)(w0 * m1 + w2 * m2), (float)(w1 * m1 + w3 * m2)};
        double* const by_covariance = g_covars2d + 3 * (long long)thread;
        by_covariance[0] = 0.5 * (w0 * (w0 * m3 + w2 * m4) + w2 * (w0 * m4 + w2 * m5));
        by_covariance[1] = w1 * (w0 * m3 + w2 * m4) + w3 * (w0 * m4 + w2 * m5);
        by_covariance[2] = 0.5 * (w1 * (w1 * m3 + w3 * m4) + w3 * (w1 * m4 + w3 * m5));
        g_opacities[thread] =
            count ? sums[0] / opacities[opacities_given == total ? thread : thread % opacities_given] : 0.f;
    }
}
