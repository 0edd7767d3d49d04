// Contact on CUDA, the rules of `contact.py`, by warps and parts of them, for each part or vertex of each image.
//
// `boxes` (parts, then a thread per vertex for normals) -> `meetings` (parts; a lane for each part of a group) ->
// `find` (vertices; a lane for each part or vertex of a part) -> rounds of `contacts` and `spread` (vertices; `LANES`
// lanes for the neighbours) -> `closeness`. Of two vertices equally near, the one that stands first is taken, as on the
// CPU.

__global__ void boxes(
#include "contact_parameters.inc"
    int box_blocks,
    const int* offsets,  // [V + 1]; corners of vertex v are entries[offsets[v] .. offsets[v + 1] - 1]
    const int* entries,  // [3 F]; 3 face + corner
    const int* faces,    // [F, 3]
    const int* samples,  // [P, E]
    int n_samples,
    float outward,
    float pad
) {
#include "../posing/vectors_cuda.h"
    auto area_vector = [&](const float* x, int f) -> V3 {
        const V3 a = get3(x, faces[3 * f]);
        return cross(minus(get3(x, faces[3 * f + 1]), a), minus(get3(x, faces[3 * f + 2]), a));
    };
    auto unit = [&](V3 v) -> V3 {
        const float length = sqrtf(dot3(v, v));
        return scaled(length > 0.f ? outward / length : 0.f, v);
    };
    if (block_index >= box_blocks) {
        const long long row = (long long)(block_index - box_blocks) * BLOCK + threadIdx.x;
        if (row >= (long long)batch * n) return;
        const long long b = row / n;
        const int v = (int)(row - b * n);
        V3 total = {0.f, 0.f, 0.f};
        for (int e = offsets[v]; e < offsets[v + 1]; e++)
            total = plus(total, area_vector(points + 3 * b * n, entries[e] / 3));
        put3(normals, row, unit(total));
        return;
    }
    const int row = block_index * WARPS + (threadIdx.x >> 5), lane = threadIdx.x & 31;
    if (row >= batch * n_parts) return;
    const int b = row / n_parts, p = row - b * n_parts;
    const float* x = points + 3ll * b * n;
    V3 low = get3(x, members[starts[p]]), high = low, total = {0.f, 0.f, 0.f};
    for (int e = starts[p] + lane; e < starts[p + 1]; e += 32) {
        const V3 y = get3(x, members[e]);
        low = {fminf(low.x, y.x), fminf(low.y, y.y), fminf(low.z, y.z)};
        high = {fmaxf(high.x, y.x), fmaxf(high.y, y.y), fmaxf(high.z, y.z)};
    }
    for (int k = lane; k < n_samples; k += 32) total = plus(total, area_vector(x, samples[p * n_samples + k]));
    for (int step = 16; step > 0; step >>= 1) {
        auto other = [&](float y) -> float { return __shfl_xor_sync(0xffffffffu, y, step); };
        low = {fminf(low.x, other(low.x)), fminf(low.y, other(low.y)), fminf(low.z, other(low.z))};
        high = {fmaxf(high.x, other(high.x)), fmaxf(high.y, other(high.y)), fmaxf(high.z, other(high.z))};
        total = plus(total, {other(total.x), other(total.y), other(total.z)});
    }
    if (lane) return;
    const V3 facing = unit(total), under = scaled(-reach, facing);
    auto put = [&](int column, V3 a, float w) { put4(boxes, (5ll * b + column) * n_parts + p, {a.x, a.y, a.z, w}); };
    put(0, low, 0.f);
    put(1, high, 0.f);
    put(2, {low.x + fminf(under.x, 0.f) - pad, low.y + fminf(under.y, 0.f) - pad, low.z + fminf(under.z, 0.f) - pad},
        0.f);
    put(3, {high.x + fmaxf(under.x, 0.f) + pad, high.y + fmaxf(under.y, 0.f) + pad, high.z + fmaxf(under.z, 0.f) + pad},
        0.f);
    put(4, facing, 0.f);
    state[row] = 0;
}

__global__ void meetings(
#include "contact_parameters.inc"
    const int* allowed,  // [P, G]
    const int* beside,   // [P, A]
    int n_beside,
    float opposed
) {
#include "../posing/vectors_cuda.h"
    const int row = block_index * WARPS + (threadIdx.x >> 5), lane = threadIdx.x & 31;
    if (row >= batch * n_parts) return;
    const int b = row / n_parts, p = row - b * n_parts;
    auto get = [&](int column, int q) -> V3 {
        const V4 a = get4(boxes, (5ll * b + column) * n_parts + q);
        return {a.w, a.x, a.y};
    };
    auto overlap = [](V3 low, V3 high, V3 other_low, V3 other_high) -> bool {
        return low.x < other_high.x && low.y < other_high.y && low.z < other_high.z && high.x > other_low.x &&
               high.y > other_low.y && high.z > other_low.z;
    };
    const V3 low = get(0, p), high = get(1, p), deep_low = get(2, p), deep_high = get(3, p), facing = get(4, p);
    unsigned any = 0;
#pragma unroll 3
    for (int g = 0; g < n_groups; g++) {
        const unsigned bits = (unsigned)allowed[p * n_groups + g];
        bool meets = false;
        if (bits >> lane & 1) {
            const int q = 32 * g + lane;
            const V3 other_low = get(2, q), other_high = get(3, q);
            meets = overlap(deep_low, deep_high, other_low, other_high) && dot3(facing, get(4, q)) < opposed &&
                    (overlap(low, high, other_low, other_high) || overlap(get(0, q), get(1, q), deep_low, deep_high));
        }
        const unsigned found = __ballot_sync(0xffffffffu, meets);
        if (lane == 0) met[(long long)row * n_groups + g] = (int)found;
        any |= found;
    }
    if (any)
        for (int k = lane; k < n_beside; k += 32) {
            const int q = beside[p * n_beside + k];
            if (q >= 0) atomicMax(state + b * n_parts + q, k == 0 ? 2 : 1);
        }
}

__global__ void find(
#include "contact_parameters.inc"
    float opposed
) {
#include "../posing/vectors_cuda.h"
#include "contact_keys.h"
    const long long row = (long long)block_index * WARPS + (threadIdx.x >> 5);
    const int lane = threadIdx.x & 31;
    if (row >= (long long)batch * n) return;
    const long long b = row / n;
    const int v = (int)(row - b * n), own = part[v];
    int found = -1;
    if (state[b * n_parts + own] == 2) {
        const float *x = points + 3 * b * n, *facing = normals + 3 * b * n;
        const V3 here = get3(x, v), normal = get3(facing, v);
        const Key none = key_of(reach * reach, -1);
        Key best = none;
        for (int g = 0; g < n_groups; g++) {
            const unsigned bits = (unsigned)met[(b * n_parts + own) * n_groups + g];
            if (!bits) continue;
            bool near = false;
            if (bits >> lane & 1) {
                const int p = 32 * g + lane;
                const V4 low = get4(boxes, 5 * b * n_parts + p), high = get4(boxes, (5 * b + 1) * n_parts + p);
                const V3 past = {
                    fmaxf(fmaxf(low.w - here.x, here.x - high.w), 0.f),
                    fmaxf(fmaxf(low.x - here.y, here.y - high.x), 0.f),
                    fmaxf(fmaxf(low.y - here.z, here.z - high.y), 0.f)
                };
                near = dot3(past, past) < squared_of(best);
            }
            unsigned left = __ballot_sync(0xffffffffu, near);
            if (!left) continue;
            for (; left; left &= left - 1) {
                const int p = 32 * g + __ffs(left) - 1;
                for (int e = starts[p] + lane; e < starts[p + 1]; e += 32) {
                    const int j = members[e];
                    const V3 r = minus(get3(x, j), here);
                    const float distance = dot3(r, r);
                    if (distance < squared_of(best) && dot3(normal, get3(facing, j)) < opposed)
                        best = key_of(distance, e);
                }
            }
            best = nearest_of(best, 0xffffffffu, 32);
        }
        if (best < none) found = members[(int)(unsigned)best];
    }
    if (lane == 0) others[row] = found;
}

__global__ void contacts(
#include "contact_parameters.inc"
#include "contact_neighbours.inc"
    const float* shifts,  // [B, V, 3]; 0 in the first round
    float opposed,
    float aside,
    float margin
) {
#include "../posing/vectors_cuda.h"
#include "contact_nearest.h"
    V4 wish = {0.f, 0.f, 0.f, 0.f};
    if (last >= 0) {
        const float both = give[v] + give[other];
        if (depth > -margin && dot3(r, r) - depth * depth < aside * aside && both > 0.f) {
            const V3 s = scaled((depth + margin) * give[v] / both, m);
            wish = {s.x, s.y, s.z, 1.f};
        }
    }
    if (lane == 0) put4(wanted, row, wish);
}

__global__ void spread(
#include "contact_parameters.inc"
#include "contact_neighbours.inc"
    const float* weights,  // [K]
    const float* shifts,   // [B, V, 3]; 0 in the first round
    float fades,
    const float* changes,  // [B, K] or 0, for the last round: see `contact_shifts`
    int n_changes,
    float whole,
    float* out  // [B, V, 3]
) {
#include "../posing/vectors_cuda.h"
    const long long row = (long long)block_index * (BLOCK / LANES) + threadIdx.x / LANES;
    const int lane = threadIdx.x % LANES;
    if (row >= (long long)batch * n) return;
    const long long b = row / n;
    const int v = (int)(row - b * n);
    V3 moved = {0.f, 0.f, 0.f};
    if (state[b * n_parts + part[v]] > 0) {
        const unsigned together = ((1u << LANES) - 1) << (threadIdx.x & (32 - LANES));
        V4 total = {0.f, 0.f, 0.f, 0.f};
        for (int e = offsets[v] + lane; e < offsets[v + 1]; e += LANES)
            total = plus4(total, scaled4(weights[e], get4(wanted, b * n + neighbours[e])));
        float most = 0.f;
        if (changes)
            for (int k = lane; k < n_changes; k += LANES) most = fmaxf(most, fabsf(changes[b * n_changes + k]));
        for (int step = LANES / 2; step > 0; step >>= 1) {
            auto other = [&](float y) -> float { return __shfl_xor_sync(together, y, step); };
            total = plus4(total, {other(total.w), other(total.x), other(total.y), other(total.z)});
            most = fmaxf(most, other(most));
        }
        moved = scaled(1.f / fmaxf(total.z, fades), {total.w, total.x, total.y});
        if (shifts) moved = plus(get3(shifts, row), moved);
        const float length = sqrtf(dot3(moved, moved));
        if (length > give[v]) moved = scaled(give[v] / length, moved);
        if (changes) moved = scaled(fminf(most / whole, 1.f), moved);
    }
    if (lane == 0) put3(out, row, moved);
}

__global__ void closeness(
#include "contact_parameters.inc"
#include "contact_neighbours.inc"
    const float* shifts,  // [B, V, 3]
    float opposed,
    float aside,           // half the distance between vertices, which is no gap
    const float* changes,  // [B, K] or 0: see `contact_shifts`
    int n_changes,
    float whole,
    float width,
    float* close  // [B, V]: exp(-gap / width)
) {
#include "../posing/vectors_cuda.h"
#include "contact_nearest.h"
    float found = 0.f;
    if (last >= 0) {
        const float past = sqrtf(fmaxf(dot3(r, r) - depth * depth, 0.f)) - aside;
        found = expf(-(fmaxf(-depth, 0.f) + fmaxf(past, 0.f)) / width);
        if (changes) {
            float most = 0.f;
            for (int k = 0; k < n_changes; k++) most = fmaxf(most, fabsf(changes[b * n_changes + k]));
            found *= fminf(most / whole, 1.f);
        }
    }
    if (lane == 0) close[row] = found;
}
