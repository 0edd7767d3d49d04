// Float32 posing of Gaussians on the CPU: what `barycentric` computes, 16 Gaussians at once.
//
// Backward, each Gaussian writes one row of eight for the vertices that it depends on, (by position, by area ratio, by
// rotation), and for each of its corners the weight of the second half; that of the first are its barycentrics. Then
// vertices add up the rows, and faces the gradients of area ratios.

void pose(
#include "mesh_gaussian_parameters.inc"
    long long* state,    // `STATE` words of zeros
    float* means,        // [P + Q, 3]
    float* posed_quats,  // [P + Q, 4]
    float* posed_scales  // [P + Q, 3]
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
#include "mesh_gaussians_vectors.h"
    const Table table = table3(vertices, n_vertices);
    ranges(state, n_on_vertices, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
#include "on_vertex.h"
            const V4 vertex = rows([&](int lane) -> Q { return at3(table, v[lane]); });
            const V3 shift = plus(o, plus(scaled(q.w, t), cross(u, t)));
            put3(means + 3ll * i, count, plus({vertex.w, vertex.x, vertex.y}, shift));
            put4(posed_quats + 4ll * i, count, product(q, get4(quats + 4ll * i, count)));
            put3(posed_scales + 3ll * i, count, scaled(grown, get3(scales + 3ll * i, count)));
        }
    });
    ranges(state + PHASE_WORDS, n_on_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
#include "on_face.h"
            V3 mean = {zero, zero, zero};
            for (int k = 0; k < 3; k++) {
                const V4 p = rows([&](int lane) -> Q { return at3(table, c[3 * lane + k]); });
                mean = plus(mean, scaled(k == 0 ? b.x : k == 1 ? b.y : b.z, {p.w, p.x, p.y}));
            }
            put3(means + 3ll * at, count, mean);
            put4(posed_quats + 4ll * at, count, product(place.rotation, get4(quats + 4ll * at, count)));
            put3(posed_scales + 3ll * at, count, scaled(grown, get3(scales + 3ll * at, count)));
        }
    });
}

void pose_backward(
#include "mesh_gaussian_parameters.inc"
    long long* state,      // `STATE` words of zeros
    const float* g_means,  // these three may be 0
    const float* g_posed_quats,
    const float* g_posed_scales,
    const int* vertex_starts,   // [V + 1]; of `places`, for each vertex
    const int* places,          // [P + 3 Q]; i < P: the Gaussian i on a vertex; P + 3 i + k: corner k of Gaussian P + i
    const int* face_starts,     // [F + 1]; of `face_gaussians`, for each face
    const int* face_gaussians,  // [Q]
    float* gaussian_rows,       // [P + Q, 8], scratch; 0 if nothing of vertices is wanted, or nothing rides
    float* weights,             // [Q, 3], scratch, with the rows
    float* by_ratio,            // [Q], scratch; 0 if area ratios are not wanted
    float* g_vertices,          // each of these is 0 if not wanted
    float* g_barycentrics,
    float* g_vertex_quats,
    float* g_area_ratio,
    float* g_quats,
    float* g_scales,
    float* g_offsets,
    float* g_vertex_area_ratio
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
#include "mesh_gaussians_vectors.h"
    const Table table = table3(vertices, n_vertices);
    ranges(state, n_on_vertices, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
#include "on_vertex.h"
            const V3 g_mean = get3_or_zero(g_means, i, count), g_scale = get3_or_zero(g_posed_scales, i, count);
            const V4 g_quat = get4_or_zero(g_posed_quats, i, count);
            if (g_offsets) {
                const V3 back = scaled((V)(2.f), cross(u, g_mean));
                put3(g_offsets + 3ll * i, count, plus(g_mean, minus(cross(u, back), scaled(q.w, back))));
            }
            if (g_quats) put4(g_quats + 4ll * i, count, product(conjugate(q), g_quat));
            if (g_scales) put3(g_scales + 3ll * i, count, scaled(grown, g_scale));
            if (gaussian_rows) {
                V4 g = plus4(product(g_quat, conjugate(get4(quats + 4ll * i, count))), by_rotation(g_mean, q, u, o, t));
                g = unnormalised(g, q, place.per_length);
                const V slope = growth_slope(pick(vertex_area_ratio, v));
                const V by_area = slope * dot3(g_scale, get3(scales + 3ll * i, count));
                put4(gaussian_rows + 8ll * i, count, {g_mean.x, g_mean.y, g_mean.z, by_area}, 8);
                put4(gaussian_rows + 8ll * i + 4, count, g, 8);
            }
        }
    });
    ranges(state + PHASE_WORDS, n_on_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
#include "on_face.h"
            const V3 g_mean = get3_or_zero(g_means, at, count), g_scale = get3_or_zero(g_posed_scales, at, count);
            const V4 g_quat = get4_or_zero(g_posed_quats, at, count);
            if (g_quats) put4(g_quats + 4ll * at, count, product(conjugate(place.rotation), g_quat));
            if (g_scales) put3(g_scales + 3ll * at, count, scaled(grown, g_scale));
            if (by_ratio) {
                const V slope = growth_slope(ratio);
                put(by_ratio + i, count, slope * dot3(g_scale, get3(scales + 3ll * at, count)));
            }
            if (gaussian_rows || g_barycentrics) {
                V4 g = product(g_quat, conjugate(get4(quats + 4ll * at, count)));
                g = unnormalised(g, place.rotation, place.per_length);
                if (gaussian_rows) {
                    put4(gaussian_rows + 8ll * at, count, {g_mean.x, g_mean.y, g_mean.z, zero}, 8);
                    put4(gaussian_rows + 8ll * at + 4, count, g, 8);
                    put3(weights + 3ll * i, count, {b.x * place.sign.x, b.y * place.sign.y, b.z * place.sign.z});
                }
                if (g_barycentrics) {
                    V by[3];
                    for (int k = 0; k < 3; k++) {
                        const V4 p = rows([&](int lane) -> Q { return at3(table, c[3 * lane + k]); });
                        const V sign = k == 0 ? place.sign.x : k == 1 ? place.sign.y : place.sign.z;
                        by[k] = dot3(g_mean, {p.w, p.x, p.y}) + sign * dot4(g, q[k]);
                    }
                    put3(g_barycentrics + 3ll * i, count, {by[0], by[1], by[2]});
                }
            }
        }
    });

    // A vertex's places: 0 .. n - 1 are Gaussians on it, n + 3 i + k is the corner k of Gaussian n + i.
    const bool wanted = g_vertices || g_vertex_quats || g_vertex_area_ratio;
    if (wanted)
        ranges(state + 2 * PHASE_WORDS, n_vertices, [&](int first, int end) {
            for (int v = first; v < end; v++) {
                Q low = (Q)(0.f), high = (Q)(0.f);  // by position and area ratio; by rotation
                for (int j = vertex_starts[v]; j < vertex_starts[v + 1]; j++) {
                    const unsigned place = (unsigned)places[j];
                    const bool corner = place >= (unsigned)n_on_vertices;
                    const unsigned at = place - (unsigned)n_on_vertices;
                    const float* row = gaussian_rows + 8ll * (corner ? (unsigned)n_on_vertices + at / 3u : place);
                    low += (corner ? barycentrics[at] : 1.f) * load_row(row);
                    high += (corner ? weights[at] : 1.f) * load_row(row + 4);
                }
                if (g_vertices) memcpy(g_vertices + 3ll * v, &low, 3 * sizeof(float));
                if (g_vertex_quats) store_row(g_vertex_quats + 4ll * v, high);
                if (g_vertex_area_ratio) g_vertex_area_ratio[v] = low.w;
            }
        });
    if (g_area_ratio)
        ranges(state + 3 * PHASE_WORDS, n_faces, [&](int first, int end) {
            for (int f = first; f < end; f++) {
                float total = 0.f;
                for (int j = face_starts[f]; j < face_starts[f + 1]; j++) total += by_ratio[face_gaussians[j]];
                g_area_ratio[f] = total;
            }
        });
}
