// The light of vertices on the CPU, 16 at once.
//
// Phases: the agreement of each image with the photo, the coarse vertices around which the sky opens, the vertices.

void light_vertices(
#include "vertex_light_parameters.inc"
    long long* state  // `STATE` words of zeros
) {
#pragma clang fp contract(fast)
#include "../posing/vectors.h"
#include "../runtime/ranges.h"
#define VECTOR V
#define INTEGERS I
#include "../rasterize/exponential.h"
#undef VECTOR
#undef INTEGERS
    // x^p for x >= 0 in the range of light; 0 where x is below 2^-100. log2(m 2^n) = n + log2(m) with m in
    // [sqrt(1/2), sqrt(2)), from the series of the inverse hyperbolic tangent of s = (m - 1) / (m + 1).
    auto power = [&](V x, float p) -> V {
        const I bits = __builtin_bit_cast(I, x), exponent = (bits - (I)(0x3f3504f3)) >> 23;
        const V m = __builtin_bit_cast(V, bits - (exponent << 23)), s = (m - 1.f) / (m + 1.f), q = s * s;
        const V series = (((q * (1.f / 9.f) + 1.f / 7.f) * q + 1.f / 5.f) * q + 1.f / 3.f) * q + 1.f;
        const V log = __builtin_convertvector(exponent, V) * .693147181f + 2.f * s * series;
        return x > 0x1p-100f ? exponential(p * log) : zero;
    };
#include "vertex_light.h"

    phase(state, in_photo ? batch : 0, [&](long long b) {
        V total = zero;
        for (int i = 0; i < n_vertices; i += 16) {
            const int count = wp::min(16, n_vertices - i);
            const V3 n = get3(normals + 3ll * (b * n_vertices + i), count), before = get3(in_photo + 3ll * i, count);
            total += faces_alike(n, before);  // 0 beyond the last
        }
        float sum = 0.f;
        for (int lane = 0; lane < 16; lane++) sum += total[lane];
        agreement[b] = n_vertices ? sum / n_vertices : 0.f;
    });

    ranges(state + PHASE_WORDS, seen ? (long long)batch * n_coarse : 0, [&](int first, int end) {
        for (int i = first; i < end; i++) {
            const int b = i / n_coarse, c = i - b * n_coarse;
            float most = 0.f;
            for (int k = 0; k < n_nearby; k++) {
                const int v = coarse[nearby[n_nearby * c + k]];
                most = wp::max(most, exposure[4 * ((long long)b * n_vertices + v)] - seen[v]);
            }
            opened[i] = most;
        }
    });

    const int blocks = (n_vertices + 15) / 16;
    const long long all = (long long)batch * blocks, at_once = TASK / 16;
    phase(state + 2 * PHASE_WORDS, (all + at_once - 1) / at_once, [&](long long task) {
        for (long long block = task * at_once; block < wp::min(all, (task + 1) * at_once); block++) {
            const int b = block / blocks, i = 16 * (block - (long long)b * blocks), count = wp::min(16, n_vertices - i);
            const long long at = (long long)b * n_vertices + i;
            const V3 n = get3(normals + 3 * at, count);
            V color[3] = {received(n, 0), received(n, 1), received(n, 2)}, deep = zero, weak = zero, even = zero;
            if (exposure) {
                const V4 sky = get4(exposure + 4 * at, count);
                const V hidden = closeness ? hidden_close(sky.w, get(closeness + at, count)) : zero;
                const V of[3] = {sky.x, sky.y, sky.z};
                for (int c = 0; c < 3; c++) color[c] *= arrives(of[c], hidden, c);
                even = sky.w;
            }
            for (int c = 0; c < 3; c++) color[c] = power(color[c], 1.f / gamma);
            if (in_photo) {
                weak = faces_alike(n, get3(in_photo + 3ll * i, count));
                deep = weak * ramp((V)(agreement[b]), (V)(other_pose), (V)(same_pose));
                if (seen) {
                    float around[16];
                    for (int lane = 0; lane < count; lane++) {
                        const int* corner = corners + 3ll * (i + lane);
                        const float *weight = weights + 3ll * (i + lane), *mine = opened + (long long)b * n_coarse;
                        around[lane] = 0.f;
                        for (int k = 0; k < 3; k++) around[lane] += weight[k] * mine[corner[k]];
                    }
                    const V own = more_sky(even, get(seen + i, count)), doubtful = doubt ? get(doubt + i, count) : zero;
                    under_sky(own, get(around, count), doubtful, &deep, &weak);
                }
                if (viewed) deep *= viewed[2 * b], weak *= viewed[2 * b];
                if (shade) {
                    const V3 s = get3(shade + 3ll * i, count);
                    const V by[3] = {s.x, s.y, s.z};
                    for (int c = 0; c < 3; c++) color[c] *= 1.f + deep * (by[c] - 1.f);
                    weak = beside_deep(deep, weak, s.x, s.y, s.z);
                }
                if (viewed && doubt) {
                    const V left = 1.f - get(doubt + i, count) * (1.f - viewed[2 * b + 1]);
                    deep *= left, weak *= left;
                }
            }
            float columns[5][16];
            for (int c = 0; c < 3; c++) store(columns[c], color[c]);
            store(columns[3], deep), store(columns[4], weak);
            for (int lane = 0; lane < count; lane++)
                for (int c = 0; c < 5; c++) out[5 * (at + lane) + c] = columns[c][lane];
        }
    });
}
