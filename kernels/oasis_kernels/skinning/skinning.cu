// Float32 skinning on CUDA, what `skinning` computes with H = G, of points at rest that pose correctives move before.
//
// `skin`: four threads per point share its transforms and correctives. `skin_backward` (one thread per point) writes,
// besides the gradients of a point's own inputs, the sums over the block's points of weight times gradient of the
// blended transform; `sum_blocks` (one thread an entry of a transform) adds up the blocks.

__global__ void skin(
#include "skin_parameters.inc"
    int n_poses,
    float* out_means,
    float* out_covars  // [B, N, 3]; [B, N, 3, 3]
) {
#include "../posing/vectors_cuda.h"
    const int blocks = (n + POINTS - 1) / POINTS, poses = block_index / blocks;
    const int lane = threadIdx.x & 3;  // of the four
    const int i = (block_index - poses * blocks) * POINTS + (threadIdx.x >> 2);
    const bool there = i < n;
    const float* weight = weights + (long long)(there ? i : 0) * n_joints;
    const float* corrective = displacements + (long long)(there ? i : 0) * 3 * n_correctives;
    const bool in_fours = (n_joints & 3) == 0, in_pairs = (n_correctives & 1) == 0;
    auto of_four = [](float x) -> float {  // the sum over the four, to each of them
        x += __shfl_xor_sync(0xffffffffu, x, 1);
        return x + __shfl_xor_sync(0xffffffffu, x, 2);
    };
    const V3 mean = there ? get3(means, i) : V3{0.f, 0.f, 0.f};
    const int end = min(poses * POSES + POSES, n_poses);
    for (int pose = poses * POSES; pose < end; pose++) {
        V3 x = mean;
        if (n_correctives) {
            const float* strength = strengths + (long long)pose * n_correctives;
            float shift[3] = {0.f, 0.f, 0.f};
            if (in_pairs) {
                for (int c = 2 * lane; c < n_correctives; c += 8)
                    for (int k = 0; k < 3; k++) {
                        const float2 d = *(const float2*)(corrective + k * n_correctives + c);
                        shift[k] += d.x * strength[c] + d.y * strength[c + 1];
                    }
            } else {
                for (int c = lane; c < n_correctives; c += 4)
                    for (int k = 0; k < 3; k++) shift[k] += corrective[k * n_correctives + c] * strength[c];
            }
            x = plus(x, {of_four(shift[0]), of_four(shift[1]), of_four(shift[2])});
        }
        const float* transform = transforms + (long long)pose * 12 * n_joints;
        V4 rows[3] = {};
        auto blend = [&](int j, float w) {
            for (int r = 0; r < 3; r++) rows[r] = plus4(rows[r], scaled4(w, get4(transform, 3ll * j + r)));
        };
        if (in_fours) {
            for (int j = 4 * lane; j < n_joints; j += 16) {
                const V4 w = *(const V4*)(weight + j);
                blend(j, w.w);
                blend(j + 1, w.x);
                blend(j + 2, w.y);
                blend(j + 3, w.z);
            }
        } else {
            for (int j = lane; j < n_joints; j += 4) blend(j, weight[j]);
        }
        V4 mine;  // of the four, three keep a row each
        for (int r = 0; r < 3; r++) {
            const V4 row = {of_four(rows[r].w), of_four(rows[r].x), of_four(rows[r].y), of_four(rows[r].z)};
            rows[r] = row;
            if (r == lane) mine = row;
        }
        if (!there || lane == 3) continue;
        const long long at = (long long)pose * n + i;
        out_means[3 * at + lane] = mine.w * x.x + mine.x * x.y + mine.y * x.z + mine.z;
        if (covars) {
            const float* s = covars + 9ll * i;
            auto entry = [&](int c) -> float { return mine.w * s[c] + mine.x * s[3 + c] + mine.y * s[6 + c]; };
            const V3 half = {entry(0), entry(1), entry(2)};
            for (int c = 0; c < 3; c++)
                out_covars[9 * at + 3 * lane + c] = dot3(half, {rows[c].w, rows[c].x, rows[c].y});
        }
    }
}

__global__ void skin_backward(
#include "skin_parameters.inc"
    const float* g_out_means,  // these two may be 0
    const float* g_out_covars,
    float* g_means,    // [B, N, 3]; each of these is 0 if not wanted. By the corrected points, too
    float* g_covars,   // [B, N, 3, 3]
    float* g_weights,  // [B, N, J]
    float* sums        // [B, blocks, J, 3, 4]
) {
#include "../posing/vectors_cuda.h"
    const int blocks = (n + BLOCK - 1) / BLOCK, pose = block_index / blocks;
    const int first = (block_index - pose * blocks) * BLOCK, i = first + threadIdx.x;
    const long long at = (long long)pose * n + i;
    const float* transform = transforms + (long long)pose * 12 * n_joints;
    __shared__ float by_blend[BLOCK][13];  // by the point's blended transform; 13, for the columns to lie apart
    float* mine = by_blend[threadIdx.x];
    for (int k = 0; k < 12; k++) mine[k] = 0.f;
    if (i < n) {
        V3 rows[3] = {};
        for (int j = 0; j < n_joints; j++) {
            const float w = weights[(long long)i * n_joints + j];
            for (int r = 0; r < 3; r++) {
                const V4 row = get4(transform, 3ll * j + r);
                rows[r] = plus(rows[r], scaled(w, {row.w, row.x, row.y}));
            }
        }
        V3 x = get3(means, i);
        if (n_correctives) {
            float shift[3] = {0.f, 0.f, 0.f};
            for (int c = 0; c < n_correctives; c++)
                for (int k = 0; k < 3; k++)
                    shift[k] += displacements[((long long)i * 3 + k) * n_correctives + c] *
                                strengths[(long long)pose * n_correctives + c];
            x = plus(x, {shift[0], shift[1], shift[2]});
        }
        V3 g_mean = {0.f, 0.f, 0.f};
        if (g_out_means) g_mean = get3(g_out_means, at);
        const float gm[3] = {g_mean.x, g_mean.y, g_mean.z};
        for (int r = 0; r < 3; r++) {
            mine[4 * r] = gm[r] * x.x;
            mine[4 * r + 1] = gm[r] * x.y;
            mine[4 * r + 2] = gm[r] * x.z;
            mine[4 * r + 3] = gm[r];
        }
        if (g_means) {
            const V3 back = plus(plus(scaled(gm[0], rows[0]), scaled(gm[1], rows[1])), scaled(gm[2], rows[2]));
            put3(g_means, at, back);
        }
        if (g_out_covars) {  // of G S G^T: by G it is D G S^T + D^T G S, by S it is G^T D G
            const float *s = covars + 9ll * i, *d = g_out_covars + 9 * at;
            const float g[9] = {rows[0].x, rows[0].y, rows[0].z, rows[1].x, rows[1].y,
                                rows[1].z, rows[2].x, rows[2].y, rows[2].z};
            float gs[9], gst[9], dg[9];  // G S, G S^T, D G
            for (int r = 0; r < 3; r++)
                for (int c = 0; c < 3; c++) {
                    gs[3 * r + c] = g[3 * r] * s[c] + g[3 * r + 1] * s[3 + c] + g[3 * r + 2] * s[6 + c];
                    gst[3 * r + c] = g[3 * r] * s[3 * c] + g[3 * r + 1] * s[3 * c + 1] + g[3 * r + 2] * s[3 * c + 2];
                    dg[3 * r + c] = d[3 * r] * g[c] + d[3 * r + 1] * g[3 + c] + d[3 * r + 2] * g[6 + c];
                }
            for (int r = 0; r < 3; r++)
                for (int c = 0; c < 3; c++) {
                    for (int k = 0; k < 3; k++)
                        mine[4 * r + c] += d[3 * r + k] * gst[3 * k + c] + d[3 * k + r] * gs[3 * k + c];
                    if (g_covars)
                        g_covars[9 * at + 3 * r + c] = g[r] * dg[c] + g[3 + r] * dg[3 + c] + g[6 + r] * dg[6 + c];
                }
        }
        if (g_weights)
            for (int j = 0; j < n_joints; j++) {
                float total = 0.f;
                for (int k = 0; k < 12; k++) total += mine[k] * transform[12 * j + k];
                g_weights[at * n_joints + j] = total;
            }
    }
    if (!sums) return;
    __syncthreads();
    const int count = min(BLOCK, n - first);
    for (int entry = threadIdx.x; entry < 12 * n_joints; entry += BLOCK) {
        const int j = entry / 12, k = entry - 12 * j;
        float total = 0.f;
        for (int p = 0; p < count; p++) total += weights[(long long)(first + p) * n_joints + j] * by_blend[p][k];
        sums[(long long)block_index * 12 * n_joints + entry] = total;
    }
}

__global__ void sum_blocks(
    int n_joints,
    int n_sums,
    const float* sums,   // [B, blocks, J, 3, 4]
    float* g_transforms  // ...; [B, J, 3, 4]
) {
#include "../posing/vectors_cuda.h"
    const int size = 12 * n_joints, blocks = (size + BLOCK - 1) / BLOCK, pose = block_index / blocks;
    const int entry = (block_index - pose * blocks) * BLOCK + threadIdx.x;
    if (entry >= size) return;
    double total = 0.0;
#pragma unroll 8
    for (int k = 0; k < n_sums; k++) total += (double)sums[((long long)pose * n_sums + k) * size + entry];
    g_transforms[(long long)pose * size + entry] = (float)total;
}
