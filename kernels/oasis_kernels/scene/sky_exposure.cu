// Sky exposure on CUDA, by the rules of `sky_exposure.cpp`: `draw` -> `gather` -> `smooth`. A block draws every
// `SLICES`th face, as a pair of directions sees it, into shared memory, where depths are whole numbers in the same
// order.

__global__ void draw(
#include "sky_parameters.inc"
    int n_points,        // W
    const int* members,  // [V]: the vertices that are looked at, among W
    float* middle,       // [B, 3], scratch: of the box around the vertices, in the axes that turn with the surface
    float* buffers       // [B, P, SLICES, 2, SIZE, SIZE], scratch: nearest and farthest depths
) {
#include "sky_light.h"
    __shared__ int nearest[SIZE * SIZE], farthest[SIZE * SIZE];
    __shared__ float reduced[WARPS][6];
    __shared__ float box[6];
    const float FAR = 1e30f;
    const int pair = block_index / SLICES, slice = block_index - SLICES * pair, b = pair / PAIRS, k = pair - PAIRS * b;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    const float* points = vertices + 3ll * b * n_points;
    float m[9];
    matrix_of(turns + 4 * b, m);
    if (!slice && threadIdx.x < 2)
        light_from(m, axes + 9 * k + 6, threadIdx.x ? 1.f : -1.f, lights + 3 * (2 * pair + threadIdx.x));
    // The same order as the depths that they stand for, both ways.
    auto ordered = [](float x) -> int {
        const int bits = __float_as_int(x);
        return bits < 0 ? bits ^ 0x7fffffff : bits;
    };
    auto depth_of = [](int key) -> float { return __int_as_float(key < 0 ? key ^ 0x7fffffff : key); };
    auto turned = [&](int vertex, float* to) {
        const float* p = points + 3 * members[vertex];
        for (int j = 0; j < 3; j++) to[j] = m[j] * p[0] + m[3 + j] * p[1] + m[6 + j] * p[2];
    };
    auto over_block = [&](float* values, int n) {  // the largest of each, in `box`
        for (int j = 0; j < n; j++) {
            for (int step = 16; step > 0; step >>= 1)
                values[j] = fmaxf(values[j], __shfl_xor_sync(0xffffffffu, values[j], step));
            if (!lane) reduced[warp][j] = values[j];
        }
        __syncthreads();
        if (threadIdx.x < n) {
            float most = -FAR;
            for (int w = 0; w < WARPS; w++) most = fmaxf(most, reduced[w][threadIdx.x]);
            box[threadIdx.x] = most;
        }
        __syncthreads();
    };

    float values[6] = {-FAR, -FAR, -FAR, -FAR, -FAR, -FAR}, own[3];
    for (int i = threadIdx.x; i < n_vertices; i += BLOCK) {
        turned(i, own);
        for (int j = 0; j < 3; j++) {
            values[j] = fmaxf(values[j], own[j]);
            values[3 + j] = fmaxf(values[3 + j], -own[j]);
        }
    }
    over_block(values, 6);
    float center[3];
    for (int j = 0; j < 3; j++) center[j] = (box[j] - box[3 + j]) / 2;
    __syncthreads();
    values[0] = 0.f;
    for (int i = threadIdx.x; i < n_vertices; i += BLOCK) {
        turned(i, own);
        float square = 0.f;
        for (int j = 0; j < 3; j++) square += (own[j] - center[j]) * (own[j] - center[j]);
        values[0] = fmaxf(values[0], square);
    }
    over_block(values, 1);
    const float reach = MARGIN * sqrtf(box[0]), texel = reach * (2.f / SIZE), scale = texel > 0.f ? 1.f / texel : 0.f;
    if (!k && !slice && !threadIdx.x) {
        radius[b] = reach;
        for (int j = 0; j < 3; j++) middle[3 * b + j] = center[j];
    }

    for (int i = threadIdx.x; i < SIZE * SIZE; i += BLOCK) {
        nearest[i] = ordered(FAR);
        farthest[i] = ordered(-FAR);
    }
    __syncthreads();
    const float* axis = axes + 9 * k;
    auto placed = [&](int vertex, float* to) {
        turned(vertex, own);
        for (int j = 0; j < 3; j++) {
            float at = 0.f;
            for (int c = 0; c < 3; c++) at += axis[3 * j + c] * (own[c] - center[c]);
            to[j] = j < 2 ? at * scale + (SIZE / 2 - .5f) : at;
        }
    };
    auto clamped = [](float x, float low, float high) -> int { return (int)fminf(fmaxf(x, low), high); };
    for (int f = SLICES * threadIdx.x + slice; f < n_faces; f += SLICES * BLOCK) {
        float p[3][3];
        for (int j = 0; j < 3; j++) placed(faces[3 * f + j], p[j]);
        const int left = clamped(ceilf(fminf(p[0][0], fminf(p[1][0], p[2][0]))), 0.f, SIZE);
        const int last = clamped(floorf(fmaxf(p[0][0], fmaxf(p[1][0], p[2][0]))), -1.f, SIZE - 1);
        const int top = clamped(ceilf(fminf(p[0][1], fminf(p[1][1], p[2][1]))), 0.f, SIZE);
        const int bottom = clamped(floorf(fmaxf(p[0][1], fmaxf(p[1][1], p[2][1]))), -1.f, SIZE - 1);
        const float bx = p[1][0] - p[0][0], by = p[1][1] - p[0][1], cx = p[2][0] - p[0][0], cy = p[2][1] - p[0][1];
        const float doubled = bx * cy - by * cx;
        if (!(fabsf(doubled) > 1e-12f)) continue;
        const float inverse = 1.f / doubled;
        for (int row = top; row <= bottom; row++)
            for (int column = left; column <= last; column++) {
                const float dx = column - p[0][0], dy = row - p[0][1];
                const float q = (dx * cy - dy * cx) * inverse, r = (dy * bx - dx * by) * inverse;
                if (!(q >= -SLACK && r >= -SLACK && q + r <= 1.f + SLACK)) continue;
                const int key = ordered(p[0][2] + q * (p[1][2] - p[0][2]) + r * (p[2][2] - p[0][2]));
                atomicMin(nearest + SIZE * row + column, key);
                atomicMax(farthest + SIZE * row + column, key);
            }
    }
    __syncthreads();
    float* to = buffers + 2ll * block_index * SIZE * SIZE;
    for (int i = threadIdx.x; i < SIZE * SIZE; i += BLOCK) {
        to[i] = depth_of(nearest[i]);
        to[SIZE * SIZE + i] = depth_of(farthest[i]);
    }
}

__global__ void gather(
#include "sky_parameters.inc"
    int n_points,
    const int* members,
    const float* middle,  // from `draw`
    const float* buffers  // likewise
) {
#include "sky_light.h"
    const long long i = (long long)block_index * (BLOCK / PAIRS) + threadIdx.x / PAIRS;
    const int k = threadIdx.x % PAIRS;
    const bool there = i < (long long)batch * n_vertices;
    float sums[8] = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f};  // seen, then all
    if (there) {
        const int b = (int)(i / n_vertices);
        const long long at_point = (long long)b * n_points + members[i - (long long)b * n_vertices];
        const float *p = vertices + 3 * at_point, *n = normals + 3 * at_point, *axis = axes + 9 * k;
        float m[9];
        matrix_of(turns + 4 * b, m);
        const float texel = radius[b] * (2.f / SIZE), scale = texel > 0.f ? 1.f / texel : 0.f;
        float at[3] = {0.f, 0.f, 0.f}, tilt[3] = {0.f, 0.f, 0.f};  // along the axes
        for (int j = 0; j < 3; j++) {
            const float place = m[j] * p[0] + m[3 + j] * p[1] + m[6 + j] * p[2] - middle[3 * b + j];
            const float normal = m[j] * n[0] + m[3 + j] * n[1] + m[6 + j] * n[2];
            for (int c = 0; c < 3; c++) {
                at[c] += axis[3 * c + j] * place;
                tilt[c] += axis[3 * c + j] * normal;
            }
        }
        const float cosine = -tilt[2], size = fabsf(cosine), depth = at[2] - LIFT * cosine;
        const float tangent = size > 0.f ? sqrtf(fmaxf(1.f - size * size, 0.f)) / size : STEEPEST;
        const float bias = LIFT + fminf(tangent, STEEPEST) * texel;
        const float u = (at[0] + LIFT * tilt[0]) * scale + (SIZE / 2 - .5f);
        const float v = (at[1] + LIFT * tilt[1]) * scale + (SIZE / 2 - .5f);
        const float column = floorf(fminf(fmaxf(u, -1.f), SIZE)), row = floorf(fminf(fmaxf(v, -1.f), SIZE));
        const float part_x = u - column, part_y = v - row;
        const float* buffer = buffers + (2ll * (b * PAIRS + k) * SLICES + (cosine > 0.f ? 0 : 1)) * SIZE * SIZE;
        float share = 0.f;
        for (int j = 0; j < 4; j++) {
            const int x = (int)fminf(fmaxf(column + j % 2, 0.f), SIZE - 1);
            const int y = (int)fminf(fmaxf(row + j / 2, 0.f), SIZE - 1);
            float gap = 1e30f;
            for (int slice = 0; slice < SLICES; slice++) {
                const float hides = buffer[2 * SIZE * SIZE * slice + SIZE * y + x];
                gap = fminf(gap, cosine > 0.f ? hides - depth : depth - hides);
            }
            const float weight = (j % 2 ? part_x : 1.f - part_x) * (j / 2 ? part_y : 1.f - part_y);
            share += weight * fminf(fmaxf((gap + bias) * (1.f / LIFT) + 1.f, 0.f), 1.f);
        }
        const float* light = lights + 3 * (2 * (b * PAIRS + k) + (cosine > 0.f ? 0 : 1));
        for (int j = 0; j < 4; j++) {
            sums[4 + j] = weights[k] * size * (j ? light[j - 1] : 1.f);
            sums[j] = share * sums[4 + j];
        }
    }
    for (int step = PAIRS / 2; step > 0; step >>= 1)
        for (int j = 0; j < 8; j++) sums[j] += __shfl_xor_sync(0xffffffffu, sums[j], step);
    if (there && k < 4) rough[4 * i + k] = sums[4 + k] > LEAST ? fminf(sums[k] / sums[4 + k], 1.f) : 1.f;
}

__global__ void smooth(
#include "sky_parameters.inc"
) {
    const long long i = (long long)block_index * (BLOCK / LANES) + threadIdx.x / LANES;
    const bool there = i < (long long)batch * n_vertices;
    const long long b = there ? i / n_vertices : 0;
    const int v = there ? (int)(i - b * n_vertices) : 0, begin = offsets[v], count = offsets[v + 1] - begin;
    const int lane = threadIdx.x % LANES;
    float total[4] = {0.f, 0.f, 0.f, 0.f};
    for (int e = lane; there && e < count; e += LANES)
        for (int j = 0; j < 3; j++) {
            const float* other = rough + 4 * (b * n_vertices + faces[3 * (entries[begin + e] / 3) + j]);
            for (int c = 0; c < 4; c++) total[c] += other[c];
        }
    for (int step = LANES / 2; step > 0; step >>= 1)
        for (int c = 0; c < 4; c++) total[c] += __shfl_xor_sync(0xffffffffu, total[c], step);
    if (there && lane < 4) out[4 * i + lane] = count ? total[lane] * (1.f / (3.f * count)) : rough[4 * i + lane];
}
