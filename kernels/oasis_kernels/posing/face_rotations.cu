// Float32 face and vertex rotations on CUDA: `face_rotation` by the formulas of `face_rotations.cpp`.
//
// `rotate_faces` (one thread per face) -> `rotate_vertices` (one thread per vertex, over its faces). Backward:
// `rotate_faces_backward` (one thread per face, which looks at its three vertices) -> `gather_edges` (one thread per
// vertex, over its corners). What a face is at rest is either worked out on the way or read from a table that
// `measure_triangles` wrote, one row of 12 a face, as the CPU kernels have it.

__global__ void measure_triangles(
#include "face_parameters.inc"
    float* out
) {
#include "vectors_cuda.h"
    const long long f = (long long)block_index * BLOCK + threadIdx.x;
    if (f >= n_faces) return;
    const float* triangles = nullptr;
#include "face_cuda.h"
    const int corner[3] = {faces[3 * f], faces[3 * f + 1], faces[3 * f + 2]};
    Start from;
    const Triangle o = at_rest(f, corner, from);
    const Row row = to_row(o, from);
    put4(out, 3 * f, row.p);
    put4(out, 3 * f + 1, row.q);
    put4(out, 3 * f + 2, row.r);
}

__global__ void rotate_faces(
#include "face_parameters.inc"
    const float* triangles,       // [F, 12], from `measure_triangles`, or 0
    const float* posed_vertices,  // [B, V, 3]
    float* face_quats,            // [B, F, 4]
    float* area_ratio,            // [B, F]
    float* rows_of_faces,         // [B, F, 8]: weight times quaternion; weight, damped rest and posed area, 0
    int* flat_blocks              // one number per block: whether one of its faces has no rotation of its own
) {
#include "vectors_cuda.h"
#include "face_cuda.h"
    const int blocks = (n_faces + BLOCK - 1) / BLOCK, pose = block_index / blocks;
    const int f = (block_index - pose * blocks) * BLOCK + threadIdx.x;
    const long long at = (long long)pose * n_faces + f;
    bool proper = true;
    if (f < n_faces) {
        const int corner[3] = {faces[3 * f], faces[3 * f + 1], faces[3 * f + 2]};
        const Pair p = pair(posed_vertices + (long long)pose * 3 * n_vertices, f, corner);
        proper = p.proper;
        const V4 q = quaternion_of(p);
        const float area = p.damped * p.rest.unit * p.rest.unit;
        put4(face_quats, at, q);
        area_ratio[at] = p.ratio;
        put4(rows_of_faces, 2 * at, scaled4(p.weight, q));
        put4(rows_of_faces, 2 * at + 1, {p.weight, area, p.ratio * area, 0.f});
    }
    const int any = __syncthreads_or(!proper);
    if (threadIdx.x == 0) flat_blocks[block_index] = any;
}

__global__ void rotate_vertices(
    int n_vertices,
    int n_faces,
    const int* offsets,          // [V + 1]; corners of vertex v are corners[offsets[v] .. offsets[v + 1] - 1]
    const int* corners,          // [3 F]; 3 face + corner
    const float* rows_of_faces,  // [B, F, 8]: weight times quaternion; weight, damped rest and posed area, 0
    const int* flat_blocks,      // one number per block: whether one of its faces has no rotation of its own
    float* face_quats,           // [B, F, 4]
    float* vertex_quats,         // [B, V, 4]
    float* vertex_area_ratio,    // [B, V]
    float* signs,                // [B, F, 3] or 0: what each corner's quaternion counted with
    float* sums                  // [B, 2, V] or 0: length of the sum before it was normalised; rest areas
) {
#include "vectors_cuda.h"
    const int blocks = (n_vertices + BLOCK - 1) / BLOCK, face_blocks = (n_faces + BLOCK - 1) / BLOCK;
    const int pose = block_index / blocks, mine = block_index - pose * blocks;
    const float* rows = rows_of_faces + (long long)pose * n_faces * 8;
    float* quats_of_faces = face_quats + (long long)pose * n_faces * 4;
    const int* flat = flat_blocks + (long long)pose * face_blocks;
    const int v = mine * BLOCK + threadIdx.x;
    const bool there = v < n_vertices;
    const int begin = there ? offsets[v] : 0, end = there ? offsets[v + 1] : 0;
    float heaviest = 0.f, before = 0.f, after = 0.f;
    V4 reference = {0.f, 0.f, 0.f, 0.f}, total = reference;
    auto look = [&](V4 q, V4 areas) {
        before += areas.x;
        after += areas.y;
        if (areas.w > heaviest) {
            heaviest = areas.w;
            reference = q;
        }
    };
    auto add = [&](int j, V4 q) {
        const float sign = dot4(q, reference) < 0.f ? -1.f : 1.f;
        total = plus4(total, scaled4(sign, q));
        if (signs) signs[(long long)pose * 3 * n_faces + corners[j]] = sign;
    };
    float per_weight = 0.f;
    if (n_faces > 0) {
        // All loads of the first faces start at once, those past the last one too; their rows stay for the second look.
        unsigned f[KEPT];
        V4 kept[KEPT], areas[KEPT];
#pragma unroll
        for (int j = 0; j < KEPT; j++) f[j] = (unsigned)corners[min(begin + j, max(end - 1, 0))] / 3u;
#pragma unroll
        for (int j = 0; j < KEPT; j++) {
            kept[j] = get4(rows, 2ll * f[j]);
            areas[j] = get4(rows, 2ll * f[j] + 1);
        }
#pragma unroll
        for (int j = 0; j < KEPT; j++)
            if (begin + j < end) look(kept[j], areas[j]);
        for (int j = begin + KEPT; j < end; j++) {
            const unsigned more = (unsigned)corners[j] / 3u;
            look(get4(rows, 2ll * more), get4(rows, 2ll * more + 1));
        }
        per_weight = heaviest > 0.f ? 1.f / heaviest : 0.f;
        reference = scaled4(per_weight, reference);
#pragma unroll
        for (int j = 0; j < KEPT; j++)
            if (begin + j < end) add(begin + j, kept[j]);
        for (int j = begin + KEPT; j < end; j++) add(j, get4(rows, 2ll * ((unsigned)corners[j] / 3u)));
    }
    const bool turned = heaviest > 0.f;
    total = scaled4(per_weight, total);
    const float length = sqrtf(dot4(total, total));
    V4 q = scaled4(turned ? 1.f / length : 0.f, total);

    // What has no rotation of its own gets that of the largest face, so that a rigid motion still acts rigidly. A block
    // looks for it if one of its vertices needs it, or a face in one of the blocks of faces that it looks after.
    bool missing = there && !turned;
    for (int k = mine; k < face_blocks; k += blocks) missing |= flat[k] != 0;
    if (__syncthreads_or(missing)) {
        __shared__ unsigned long long largest;  // its weight, then the lower index
        if (threadIdx.x == 0) largest = 0;
        __syncthreads();
        unsigned long long found = 0;
        for (int f = threadIdx.x; f < n_faces; f += BLOCK) {
            const float weight = rows[8ll * f + 4];
            const unsigned long long key = (unsigned long long)__float_as_uint(weight) << 32 | (0xffffffffu - f);
            if (weight > 0.f && key > found) found = key;
        }
        atomicMax(&largest, found);
        __syncthreads();
        const V4 other = largest ? get4(quats_of_faces, 0xffffffffu - (unsigned)largest) : identity;
        if (!turned) q = other;
        for (int k = mine; k < face_blocks; k += blocks) {
            const int f = k * BLOCK + threadIdx.x;
            if (f < n_faces && !(rows[8ll * f + 4] > 0.f)) put4(quats_of_faces, f, other);
        }
    }
    if (there) {
        const long long at = (long long)pose * n_vertices + v;
        put4(vertex_quats, at, q);
        vertex_area_ratio[at] = before > 0.f ? after / before : 1.f;
        if (sums) {
            float* of_pose = sums + (long long)pose * 2 * n_vertices;
            of_pose[v] = turned ? length * heaviest : 0.f;
            of_pose[n_vertices + v] = before;
        }
    }
}

__global__ void rotate_faces_backward(
#include "face_parameters.inc"
    const float* triangles,          // [F, 12], from `measure_triangles`, or 0
    const float* posed_vertices,     // [B, V, 3]
    const float* vertex_quats,       // [B, V, 4]
    const float* face_quats,         // [B, F, 4]
    const float* vertex_area_ratio,  // [B, V]
    const float* signs,              // [B, F, 3] or 0: what each corner's quaternion counted with
    const float* sums,               // [B, 2, V] or 0: length of the sum before it was normalised; rest areas
    const float* g_vertex_quats,     // these four may be 0
    const float* g_face_quats,
    const float* g_area_ratio,
    const float* g_vertex_area_ratio,
    float* rest_edges,  // [B, F, 8]: by e1, 0, by e2, 0 as seen from corner 0; 0 if not wanted
    float* posed_edges
) {
#include "vectors_cuda.h"
#include "face_cuda.h"
    const int blocks = (n_faces + BLOCK - 1) / BLOCK, pose = block_index / blocks;
    const int f = (block_index - pose * blocks) * BLOCK + threadIdx.x;
    if (f >= n_faces) return;
    const long long at = (long long)pose * n_faces + f, first_vertex = (long long)pose * n_vertices;
    const int corner[3] = {faces[3 * f], faces[3 * f + 1], faces[3 * f + 2]};
    const Pair p = pair(posed_vertices + 3 * first_vertex, f, corner);
    const Triangle &r = p.rest, &o = p.posed;

    const V4 q = get4(face_quats, at);
    V4 g = {0.f, 0.f, 0.f, 0.f};
    if (g_face_quats) g = get4(g_face_quats, at);
    float g_weight = 0.f, by_posed = 0.f, by_rest = 0.f;  // with respect to areas
    const float* of_pose = sums + 2 * first_vertex;
    for (int k = 0; k < 3; k++) {
        const long long v = first_vertex + corner[k];
        if (g_vertex_quats) {  // by the sum of quaternions before it was normalised
            const float length = of_pose[corner[k]];
            const V4 unit = get4(vertex_quats, v), by_unit = get4(g_vertex_quats, v);
            V4 sum = plus4(by_unit, scaled4(-dot4(by_unit, unit), unit));
            sum = scaled4(length > 0.f ? signs[3 * at + k] / length : 0.f, sum);
            g = plus4(g, scaled4(p.weight, sum));
            g_weight += dot4(sum, q);
        }
        if (g_vertex_area_ratio) {
            const float area = of_pose[n_vertices + corner[k]];
            const float by_ratio = area > 0.f ? g_vertex_area_ratio[v] / area : 0.f;
            by_posed += by_ratio;
            by_rest -= vertex_area_ratio[v] * by_ratio;
        }
    }
    // A spin d of the rotation changes its quaternion by (0, d) q / 2.
    const V3 u = {q.x, q.y, q.z}, gu = {g.x, g.y, g.z};
    V3 omega = minus(minus(scaled(q.w, gu), scaled(g.w, u)), cross(gu, u));
    omega = scaled(p.proper ? 0.5f : 0.f, omega);
    const float g_ratio = g_area_ratio ? g_area_ratio[at] : 0.f;
#define PUT_EDGE put4
#include "edge_gradients.h"
}

__global__ void gather_edges(
    int n_vertices,
    int n_faces,
    const int* offsets,       // [V + 1]; corners of vertex v are corners[offsets[v] .. offsets[v + 1] - 1]
    const int* corners,       // [3 F]; 3 face + corner
    const float* rest_edges,  // [B, F, 8]: by e1, 0, by e2, 0 as seen from corner 0; 0 if not wanted
    const float* posed_edges,
    float* g_rest,  // [B, V, 3]; 0 if not wanted
    float* g_posed
) {
#include "vectors_cuda.h"
    const int blocks = (n_vertices + BLOCK - 1) / BLOCK, pose = block_index / blocks;
    const int v = (block_index - pose * blocks) * BLOCK + threadIdx.x;
    if (v >= n_vertices) return;
    auto gather = [&](const float* edges, float* to) {
        if (!to) return;
        edges += (long long)pose * n_faces * 8;
        V3 total = {0.f, 0.f, 0.f};
        for (int j = offsets[v]; j < offsets[v + 1]; j++) {
            const unsigned f = (unsigned)corners[j] / 3u, k = (unsigned)corners[j] - 3u * f;
            const V4 e1 = get4(edges, 2ll * f), e2 = get4(edges, 2ll * f + 1);
            const float by_e1 = k == 0 ? -1.f : k == 1 ? 1.f : 0.f, by_e2 = k == 0 ? -1.f : k == 2 ? 1.f : 0.f;
            total = plus(total, plus(scaled(by_e1, {e1.w, e1.x, e1.y}), scaled(by_e2, {e2.w, e2.x, e2.y})));
        }
        put3(to, (long long)pose * n_vertices + v, total);
    };
    gather(rest_edges, g_rest);
    gather(posed_edges, g_posed);
}
