// Float32 posing of Gaussians on CUDA: what `barycentric` computes.
//
// `pose_mesh_gaussians` (one thread per Gaussian; blocks for those on vertices, then blocks for those on faces).
// Backward: `pose_mesh_gaussians_backward` (likewise) writes each Gaussian's row of eight for the vertices that it
// depends on, (by position, by area ratio, by rotation), and for each of its corners the weight of the second half;
// that of the first are its barycentrics. Then `gather_mesh_gaussians` (blocks for vertices, then blocks for faces; one
// thread each) adds up the rows at vertices, and the gradients of area ratios at faces.

__global__ void pose_mesh_gaussians(
#include "mesh_gaussian_parameters.inc"
    float* means,        // [B, P + Q, 3]
    float* posed_quats,  // [B, P + Q, 4]
    float* posed_scales  // [B, P + Q, 3]
) {
#include "vectors_cuda.h"
#include "mesh_gaussians_cuda.h"
    V3 mean;
    V4 rotation;
    float ratio;
    if (on_vertex) {
        const long long v = first_vertex + vertex_index[i];
        rotation = at_vertex(get4(vertex_quats, v)).q;
        const V3 u = {rotation.x, rotation.y, rotation.z}, o = get3(offsets, i), t = scaled(2.f, cross(u, o));
        mean = plus(get3(vertices, v), plus(o, plus(scaled(rotation.w, t), cross(u, t))));
        ratio = vertex_area_ratio[v];
    } else {
        const long long f = face_index[i];
        const long long v[3] = {
            first_vertex + faces[3 * f], first_vertex + faces[3 * f + 1], first_vertex + faces[3 * f + 2]
        };
        const V3 b = get3(barycentrics, i);
        const V4 q[3] = {get4(vertex_quats, v[0]), get4(vertex_quats, v[1]), get4(vertex_quats, v[2])};
        rotation = at_face(b, q).rotation;
        mean = plus(
            plus(scaled(b.x, get3(vertices, v[0])), scaled(b.y, get3(vertices, v[1]))),
            scaled(b.z, get3(vertices, v[2]))
        );
        ratio = area_ratio[(long long)pose * n_faces + f];
    }
    put3(means, at, mean);
    put4(posed_quats, at, product(rotation, get4(quats, gaussian)));
    put3(posed_scales, at, scaled(growth(ratio), get3(scales, gaussian)));
}

__global__ void pose_mesh_gaussians_backward(
#include "mesh_gaussian_parameters.inc"
    const float* g_means,  // these three may be 0
    const float* g_posed_quats,
    const float* g_posed_scales,
    float* gaussian_rows,   // [B, P + Q, 8]; 0 if nothing of vertices is wanted
    float* weights,         // [B, Q, 3], with the rows
    float* by_ratio,        // [B, Q]; 0 if area ratios are not wanted
    float* g_barycentrics,  // [B, Q, 3]; each of these is 0 if not wanted
    float* g_quats,         // [B, P + Q, 4]
    float* g_scales,        // [B, P + Q, 3]
    float* g_offsets        // [B, P, 3]
) {
#include "vectors_cuda.h"
#include "mesh_gaussians_cuda.h"
    const V3 none = {0.f, 0.f, 0.f};
    const V3 g_mean = g_means ? get3(g_means, at) : none, g_scale = g_posed_scales ? get3(g_posed_scales, at) : none;
    V4 g_quat = {0.f, 0.f, 0.f, 0.f};
    if (g_posed_quats) g_quat = get4(g_posed_quats, at);
    if (on_vertex) {
        const long long v = first_vertex + vertex_index[i];
        const OnVertex place = at_vertex(get4(vertex_quats, v));
        const V4 q = place.q;
        const V3 u = {q.x, q.y, q.z}, o = get3(offsets, i), t = scaled(2.f, cross(u, o));
        const float ratio = vertex_area_ratio[v];
        if (g_offsets) {
            const V3 back = scaled(2.f, cross(u, g_mean));
            put3(
                g_offsets, (long long)pose * n_on_vertices + i, plus(g_mean, minus(cross(u, back), scaled(q.w, back)))
            );
        }
        if (g_quats) put4(g_quats, at, product(conjugate(q), g_quat));
        if (g_scales) put3(g_scales, at, scaled(growth(ratio), g_scale));
        if (gaussian_rows) {
            V4 g = plus4(product(g_quat, conjugate(get4(quats, gaussian))), by_rotation(g_mean, q, u, o, t));
            g = unnormalised(g, q, place.per_length);
            const float by_area = growth_slope(ratio) * dot3(g_scale, get3(scales, gaussian));
            put4(gaussian_rows, 2 * at, {g_mean.x, g_mean.y, g_mean.z, by_area});
            put4(gaussian_rows, 2 * at + 1, g);
        }
        return;
    }
    const long long f = face_index[i], here = (long long)pose * n_on_faces + i;
    const long long v[3] = {
        first_vertex + faces[3 * f], first_vertex + faces[3 * f + 1], first_vertex + faces[3 * f + 2]
    };
    const V3 b = get3(barycentrics, i);
    const V4 q[3] = {get4(vertex_quats, v[0]), get4(vertex_quats, v[1]), get4(vertex_quats, v[2])};
    const OnFace place = at_face(b, q);
    const float ratio = area_ratio[(long long)pose * n_faces + f];
    if (g_quats) put4(g_quats, at, product(conjugate(place.rotation), g_quat));
    if (g_scales) put3(g_scales, at, scaled(growth(ratio), g_scale));
    if (by_ratio) by_ratio[here] = growth_slope(ratio) * dot3(g_scale, get3(scales, gaussian));
    V4 g = product(g_quat, conjugate(get4(quats, gaussian)));
    g = unnormalised(g, place.rotation, place.per_length);
    if (gaussian_rows) {
        put4(gaussian_rows, 2 * at, {g_mean.x, g_mean.y, g_mean.z, 0.f});
        put4(gaussian_rows, 2 * at + 1, g);
        put3(weights, here, {b.x * place.sign.x, b.y * place.sign.y, b.z * place.sign.z});
    }
    if (g_barycentrics) {
        float by[3];
        const float sign[3] = {place.sign.x, place.sign.y, place.sign.z};
        for (int k = 0; k < 3; k++) by[k] = dot3(g_mean, get3(vertices, v[k])) + sign[k] * dot4(g, q[k]);
        put3(g_barycentrics, here, {by[0], by[1], by[2]});
    }
}

// A vertex's places: 0 .. P - 1 are Gaussians on it, P + 3 i + k is the corner k of Gaussian P + i.
__global__ void gather_mesh_gaussians(
    int n_vertices,
    int n_faces,
    int n_on_vertices,           // P
    int n_on_faces,              // Q
    const float* barycentrics,   // [Q, 3]
    const float* gaussian_rows,  // [B, P + Q, 8]; 0 if nothing of vertices is wanted
    const float* weights,        // [B, Q, 3], with the rows
    const float* by_ratio,       // [B, Q]; 0 if area ratios are not wanted
    const int* vertex_starts,    // [V + 1]; of `places`, for each vertex
    const int* places,          // [P + 3 Q]; i < P: the Gaussian i on a vertex; P + 3 i + k: corner k of Gaussian P + i
    const int* face_starts,     // [F + 1]; of `face_gaussians`, for each face
    const int* face_gaussians,  // [Q]
    float* g_vertices,          // [B, V, 3]; each of these is 0 if not wanted
    float* g_vertex_quats,      // [B, V, 4]
    float* g_vertex_area_ratio,  // [B, V]
    float* g_area_ratio          // [B, F]
) {
#include "vectors_cuda.h"
    const int vertex_blocks = (gaussian_rows ? (n_vertices + BLOCK - 1) / BLOCK : 0),
              blocks = vertex_blocks + (g_area_ratio ? (n_faces + BLOCK - 1) / BLOCK : 0);
    const int pose = block_index / blocks, mine = block_index - pose * blocks;
    const long long first_on_face = (long long)pose * n_on_faces;
    if (mine >= vertex_blocks) {
        const int f = (mine - vertex_blocks) * BLOCK + threadIdx.x;
        if (f >= n_faces) return;
        float total = 0.f;
        for (int j = face_starts[f]; j < face_starts[f + 1]; j++) total += by_ratio[first_on_face + face_gaussians[j]];
        g_area_ratio[(long long)pose * n_faces + f] = total;
        return;
    }
    const int v = mine * BLOCK + threadIdx.x;
    if (v >= n_vertices) return;
    const float* rows = gaussian_rows + pose * ((long long)n_on_vertices + n_on_faces) * 8;
    V4 low = {0.f, 0.f, 0.f, 0.f}, high = low;  // by position and area ratio; by rotation
    for (int j = vertex_starts[v]; j < vertex_starts[v + 1]; j++) {
        const unsigned place = (unsigned)places[j];
        const bool corner = place >= (unsigned)n_on_vertices;
        const unsigned at = place - (unsigned)n_on_vertices;
        const long long row = corner ? (unsigned)n_on_vertices + at / 3u : place;
        low = plus4(low, scaled4(corner ? barycentrics[at] : 1.f, get4(rows, 2 * row)));
        high = plus4(high, scaled4(corner ? weights[3 * first_on_face + at] : 1.f, get4(rows, 2 * row + 1)));
    }
    const long long at = (long long)pose * n_vertices + v;
    if (g_vertices) put3(g_vertices, at, {low.w, low.x, low.y});
    if (g_vertex_quats) put4(g_vertex_quats, at, high);
    if (g_vertex_area_ratio) g_vertex_area_ratio[at] = low.z;
}
