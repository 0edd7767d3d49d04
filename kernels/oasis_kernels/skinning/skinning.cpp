// Skinning on the CPU, what `skinning` computes with H = G, in float32 and in float64.
//
// A transform, padded to the columns (G_0, G_1, G_2, t) of four numbers, is one vector of 16: blending four points at
// once is one multiply-add a weight. Weights are dense; skipping zeros would cost more in mispredicted branches.
//
// Gradients of the transforms are sums over all points: `sum_blends` adds up blocks of `BLOCK` points, then the blocks,
// in an order that knows nothing of threads.

void skin(
#include "cpu_skin_parameters.inc"
    T* out_means,
    T* out_covars  // [N, 3]; [N, 3, 3]
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
#include "blends.h"
    ranges(state, n, [&](int first, int end) {
        for (int i = first; i < end; i += 4) {
#include "four_blends.h"
            for (int k = 0; k < count; k++) {
#include "one_point.h"
                store3(out_means + 3 * at, g0 * x[0] + g1 * x[1] + g2 * x[2] + blends[k].hi.hi);
                if (covars) {
                    Q half[3];  // columns of G S
                    for (int c = 0; c < 3; c++) half[c] = g0 * s[c] + g1 * s[3 + c] + g2 * s[6 + c];
                    for (int r = 0; r < 3; r++)
                        store3(out_covars + 9 * at + 3 * r, half[0][r] * g0 + half[1][r] * g1 + half[2][r] * g2);
                }
            }
        }
    });
    free(columns);
}

void skin_backward(
#include "cpu_skin_parameters.inc"
    const T* g_out_means,  // these two may be 0
    const T* g_out_covars,
    T* g_means,  // each of these is 0 if not wanted
    T* g_covars,
    T* g_weights,
    T* g_blends  // [N, 16]: by the blended transform, of four padded columns
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
#include "blends.h"
    const int width = (n_joints + 15) / 16 * 16;
    T* entries = (T*)malloc(16 * (width + 1) * sizeof(T));  // an entry of all transforms a row
    for (int e = 0; e < 16; e++)
        for (int j = 0; j < width; j++) entries[e * width + j] = columns[16 * j + e];
    ranges(state, n, [&](int first, int end) {
        for (int i = first; i < end; i += 4) {
#include "four_blends.h"
            for (int k = 0; k < count; k++) {
#include "one_point.h"
                Q by_shift = (Q)(0);
                if (g_out_means) memcpy(&by_shift, g_out_means + 3 * at, 3 * sizeof(T));
                Q by0 = by_shift * x[0], by1 = by_shift * x[1], by2 = by_shift * x[2];
                if (g_out_covars) {
                    const T* g = g_out_covars + 9 * at;
                    Q left[3], right[3];  // columns of g G and of g^T G
                    const Q rows[3] = {{g[0], g[1], g[2], 0}, {g[3], g[4], g[5], 0}, {g[6], g[7], g[8], 0}};
                    const Q turned[3] = {{g[0], g[3], g[6], 0}, {g[1], g[4], g[7], 0}, {g[2], g[5], g[8], 0}};
                    const Q linear[3] = {g0, g1, g2};
                    for (int c = 0; c < 3; c++) {
                        left[c] = turned[0] * linear[c].x + turned[1] * linear[c].y + turned[2] * linear[c].z;
                        right[c] = rows[0] * linear[c].x + rows[1] * linear[c].y + rows[2] * linear[c].z;
                    }
                    // g G S^T + g^T G S
                    by0 += left[0] * s[0] + left[1] * s[1] + left[2] * s[2];
                    by1 += left[0] * s[3] + left[1] * s[4] + left[2] * s[5];
                    by2 += left[0] * s[6] + left[1] * s[7] + left[2] * s[8];
                    by0 += right[0] * s[0] + right[1] * s[3] + right[2] * s[6];
                    by1 += right[0] * s[1] + right[1] * s[4] + right[2] * s[7];
                    by2 += right[0] * s[2] + right[1] * s[5] + right[2] * s[8];
                    if (g_covars)
                        for (int r = 0; r < 3; r++)
                            for (int c = 0; c < 3; c++) g_covars[9 * at + 3 * r + c] = dot(linear[r], left[c]);
                }
                if (g_means) {
                    g_means[3 * at] = dot(g0, by_shift);
                    g_means[3 * at + 1] = dot(g1, by_shift);
                    g_means[3 * at + 2] = dot(g2, by_shift);
                }
                const Q by[4] = {by0, by1, by2, by_shift};
                if (g_blends) memcpy(g_blends + 16 * at, by, sizeof by);
                if (g_weights)
                    for (int j = 0; j < n_joints; j += 16) {
                        V total = (V)(0);
                        for (int c = 0; c < 4; c++)
                            for (int r = 0; r < 3; r++) total += by[c][r] * load(entries + (4 * c + r) * width + j);
                        memcpy(g_weights + at * n_joints + j, &total, wp::min(16, n_joints - j) * sizeof(T));
                    }
            }
        }
    });
    free(columns);
    free(entries);
}

void sum_blends(
    long long n,
    int n_joints,
    long long n_blocks,
    const T* weights,   // [N, J]
    const T* g_blends,  // [N, 16]: by the blended transform, of four padded columns
    T* sums,            // [blocks, J, 16], scratch
    T* g_transforms,    // [J, 3, 4]
    long long* state    // `STATE` words of zeros
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
    phase(state, n_blocks, [&](long long b) {
        T* to = sums + b * n_joints * 16;
        memset(to, 0, n_joints * 16 * sizeof(T));
        for (long long i = b * BLOCK; i < wp::min((b + 1) * BLOCK, n); i++) {
            const V by = load(g_blends + 16 * i);
            for (int j = 0; j < n_joints; j++) store(to + 16 * j, load(to + 16 * j) + weights[i * n_joints + j] * by);
        }
    });
    phase(state + PHASE_WORDS, n_joints, [&](long long j) {
        V total = (V)(0);
        for (long long b = 0; b < n_blocks; b++) total += load(sums + (b * n_joints + j) * 16);
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 4; c++) g_transforms[12 * j + 4 * r + c] = total[4 * c + r];
    });
}
