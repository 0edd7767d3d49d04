// The light of vertices on CUDA: `prepare` -> `light_vertices`.

// `PARTS` blocks for the agreement of each image with the photo, then a warp for each coarse vertex.
__global__ void prepare(
#include "vertex_light_parameters.inc"
) {
#include "../posing/vectors_cuda.h"
    auto power = [](float x, float p) -> float { return powf(x, p); };
#include "vertex_light.h"
    __shared__ float sums[WARPS];
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    if (block_index < PARTS * batch) {
        const int b = block_index / PARTS, first = (block_index - PARTS * b) * BLOCK + threadIdx.x;
        float total = 0.f;
        for (int v = first; in_photo && v < n_vertices; v += PARTS * BLOCK)
            total += faces_alike(get3(normals, (long long)b * n_vertices + v), get3(in_photo, v));
        for (int step = 16; step > 0; step >>= 1) total += __shfl_xor_sync(0xffffffffu, total, step);
        if (!lane) sums[warp] = total;
        __syncthreads();
        if (threadIdx.x) return;
        for (int w = 1; w < WARPS; w++) total += sums[w];
        agreement[block_index] = total / n_vertices;
        return;
    }
    const long long i = (long long)(block_index - PARTS * batch) * WARPS + warp;
    if (!seen || i >= (long long)batch * n_coarse) return;
    const int b = (int)(i / n_coarse), c = (int)(i - (long long)b * n_coarse);
    float most = 0.f;
    for (int k = lane; k < n_nearby; k += 32) {
        const int v = coarse[nearby[n_nearby * c + k]];
        most = fmaxf(most, exposure[4 * ((long long)b * n_vertices + v)] - seen[v]);
    }
    for (int step = 16; step > 0; step >>= 1) most = fmaxf(most, __shfl_xor_sync(0xffffffffu, most, step));
    if (!lane) opened[i] = most;
}

__global__ void light_vertices(
#include "vertex_light_parameters.inc"
) {
#include "../posing/vectors_cuda.h"
    auto power = [](float x, float p) -> float { return powf(x, p); };
#include "vertex_light.h"
    const long long at = (long long)block_index * BLOCK + threadIdx.x;
    if (at >= (long long)batch * n_vertices) return;
    const int b = (int)(at / n_vertices), v = (int)(at - (long long)b * n_vertices);
    const V3 n = get3(normals, at);
    float color[3] = {received(n, 0), received(n, 1), received(n, 2)};
    if (exposure) {
        const float* sky = exposure + 4 * at;
        const float hidden = closeness ? hidden_close(sky[0], closeness[at]) : 0.f;
        for (int c = 0; c < 3; c++) color[c] *= arrives(sky[1 + c], hidden, c);
    }
    for (int c = 0; c < 3; c++) color[c] = power(color[c], 1.f / gamma);
    float deep = 0.f, weak = 0.f;
    if (in_photo) {
        float alike = 0.f;
        for (int part = 0; part < PARTS; part++) alike += agreement[PARTS * b + part];
        weak = faces_alike(n, get3(in_photo, v));
        deep = weak * ramp(alike, other_pose, same_pose);
        if (seen) {
            float near = 0.f;
            for (int k = 0; k < 3; k++)
                near += weights[3 * v + k] * opened[(long long)b * n_coarse + corners[3 * v + k]];
            under_sky(more_sky(exposure[4 * at], seen[v]), near, doubt ? doubt[v] : 0.f, &deep, &weak);
        }
        if (viewed) deep *= viewed[2 * b], weak *= viewed[2 * b];
        for (int c = 0; shade && c < 3; c++) color[c] *= 1.f + deep * (shade[3 * v + c] - 1.f);
        if (shade) weak = beside_deep(deep, weak, shade[3 * v], shade[3 * v + 1], shade[3 * v + 2]);
        if (viewed && doubt) {
            const float left = 1.f - doubt[v] * (1.f - viewed[2 * b + 1]);
            deep *= left, weak *= left;
        }
    }
    for (int c = 0; c < 3; c++) out[5 * at + c] = color[c];
    out[5 * at + 3] = deep;
    out[5 * at + 4] = weak;
}
