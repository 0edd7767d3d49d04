// Float32 face and vertex rotations on the CPU: what `face_rotation` computes, 16 faces or vertices at once.
//
// Float32 suffices for triangles of any unit of length: each is first scaled by a power of two, so that its largest
// edge component lies in [1, 2), and seen from the corner where its longest rest edge begins: in the frame (t, b, n)
// with t along that edge, e1 = l t and e2 = x t + y b with y >= 0. Edges from 1e-18 to 1e15 have areas that float32 can
// hold; shorter ones count as flat.
//
// The rotation in the plane has the cosine c = l' y + l y' and the sine s = l' x - l x' over h = hypot(c, s). So R t =
// t" and R b = b" with t" = c t' + s b', b" = c b' - s t', and h is also the trace of the stretch that divides the
// gradient of the angle: all that `face_rotation.rotation_gradient` needs is at hand in the two frames.

void measure(
#include "face_parameters.inc"
    long long* state,  // `STATE` words of zeros
    float* out         // [F, TRIANGLE]
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
    const float* triangles = nullptr;
#include "face_vectors.h"
    const Table vertices = table3(rest_vertices, n_vertices);
    ranges(state, n_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
            Start from;
            const Triangle o = at_rest(vertices, i, count, corners_of(faces, i, count), from);
            const Row row = to_row(o, from);
            float* to = out + 12ll * i;
            put4(to, count, row.p, TRIANGLE);
            put4(to + 4, count, row.q, TRIANGLE);
            put4(to + 8, count, row.r, TRIANGLE);
        }
    });
}

void rotate(
#include "face_parameters.inc"
    long long* state,             // `STATE` words of zeros
    const float* triangles,       // [F, TRIANGLE], from `measure`, or 0
    const float* posed_vertices,  // [V, 3]
    const int* offsets,           // [V + 1]; corners of vertex v are corners[offsets[v] .. offsets[v + 1] - 1]
    const int* corners,           // [3 F]; 3 face + corner
    float* rows_of_faces,         // [F, 8], scratch: weight times quaternion; weight, damped rest and posed area, 0
    float* vertex_quats,          // [V, 4]
    float* face_quats,            // [F, 4]
    float* area_ratio,            // [F]
    float* vertex_area_ratio,     // [V]
    float* signs,                 // [F, 3] or 0: what each corner's quaternion counted with
    float* sums                   // [2, V] or 0: length of the sum before it was normalised; rest areas
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
#include "face_vectors.h"
    const Table before = table3(rest_vertices, n_vertices), after = table3(posed_vertices, n_vertices);
    long long* found_flat = state + FLAT_WORD;
    ranges(state, n_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
            const Pair p = pair(before, after, i, count, corners_of(faces, i, count));
            const V4 q = quaternion_of(p);
            const V square = p.rest.unit * p.rest.unit;
            put4(face_quats + 4ll * i, count, q);
            put(area_ratio + i, count, p.ratio);
            put4(rows_of_faces + 8ll * i, count, scaled4(p.weight, q), 8);
            const V area = p.damped * square;
            put4(rows_of_faces + 8ll * i + 4, count, {p.weight, area, p.ratio * area, zero}, 8);
            if (!__builtin_reduce_and(p.proper)) __atomic_store_n(found_flat, 1, __ATOMIC_RELAXED);
        }
    });

    // What has no rotation of its own gets that of the largest face, so that a rigid motion still acts rigidly.
    int known = -1;
    auto fallback = [&]() -> Q {
        if (known < 0) {
            float most = 0.f;
            known = 0;
            for (int f = 0; f < n_faces; f++)
                if (rows_of_faces[8ll * f + 4] > most) {
                    most = rows_of_faces[8ll * f + 4];
                    known = f;
                }
        }
        return n_faces ? load_row(face_quats + 4ll * known) : (Q){1.f, 0.f, 0.f, 0.f};
    };
    const int KEPT = 16;  // corners of a vertex whose rows stay at hand for the second look
    ranges(state + PHASE_WORDS, n_vertices, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
            int begins[16], lasts[16], here[16], most = 0;  // of each vertex, the places of its corners
            for (int lane = 0; lane < 16; lane++) {
                const int vertex = wp::min(i + lane, end - 1), valence = offsets[vertex + 1] - offsets[vertex];
                begins[lane] = valence ? offsets[vertex] : 0;
                lasts[lane] = valence - 1;
                most = wp::max(most, valence);
            }
            const I last = *(const IU*)lasts;
            auto gather = [&](const float* table) -> V4 {
                return rows([&](int lane) -> Q { return load_row(table + 8ll * here[lane]); });
            };
            auto look = [&](int j) {
                for (int lane = 0; lane < 16; lane++)
                    here[lane] = (unsigned)corners[begins[lane] + wp::max(wp::min(j, lasts[lane]), 0)] / 3u;
            };
            V heaviest = zero, before = zero, after = zero;
            V4 reference = {zero, zero, zero, zero}, total = reference, kept[KEPT];
            for (int j = 0; j < most; j++) {
                look(j);
                const I there = j <= last;
                const V4 a = gather(rows_of_faces + 4), q = gather(rows_of_faces);
                if (j < KEPT) kept[j] = q;
                before += there ? a.x : zero;
                after += there ? a.y : zero;
                const I better = there & (a.w > heaviest);
                heaviest = better ? a.w : heaviest;
                reference = choose4(better, q, reference);
            }
            reference = scaled4(heaviest > 0.f ? 1.f / heaviest : zero, reference);
            for (int j = 0; j < most; j++) {
                if (j >= KEPT) look(j);
                const V4 q = j < KEPT ? kept[j] : gather(rows_of_faces);
                const V sign = dot4(q, reference) < 0.f ? -one : one;
                total = plus4(total, scaled4(j <= last ? sign : zero, q));
                if (signs)
                    for (int lane = 0; lane < count; lane++)
                        if (j <= lasts[lane]) signs[corners[begins[lane] + j]] = sign[lane];
            }
            const I turned = heaviest > 0.f;
            total = scaled4(turned ? 1.f / heaviest : zero, total);
            const V length = root(dot4(total, total));
            V4 q = scaled4(turned ? 1.f / length : zero, total);
            if (!__builtin_reduce_and(turned)) {
                const Q other = fallback();
                q = choose4(turned, q, {(V)(other.x), (V)(other.y), (V)(other.z), (V)(other.w)});
            }
            put4(vertex_quats + 4ll * i, count, q);
            put(vertex_area_ratio + i, count, before > 0.f ? after / before : one);
            if (sums) {
                put(sums + i, count, turned ? length * heaviest : zero);
                put(sums + n_vertices + i, count, before);
            }
        }
    });

    const bool patch = __atomic_load_n(found_flat, __ATOMIC_RELAXED);
    if (patch)
        ranges(state + 2 * PHASE_WORDS, n_faces, [&](int first, int end) {
            for (int f = first; f < end; f++)
                if (!(rows_of_faces[8ll * f + 4] > 0.f)) {
                    const Q other = fallback();
                    store_row(face_quats + 4ll * f, other);
                }
        });
}

void rotate_backward(
#include "face_parameters.inc"
    long long* state,                // `STATE` words of zeros
    const float* triangles,          // [F, TRIANGLE], from `measure`, or 0
    const float* posed_vertices,     // [V, 3]
    const int* offsets,              // [V + 1]; corners of vertex v are corners[offsets[v] .. offsets[v + 1] - 1]
    const int* corners,              // [3 F]; 3 face + corner
    const float* vertex_quats,       // [V, 4]
    const float* face_quats,         // [F, 4]
    const float* vertex_area_ratio,  // [V]
    const float* signs,              // [F, 3] or 0: what each corner's quaternion counted with
    const float* sums,               // [2, V] or 0: length of the sum before it was normalised; rest areas
    const float* g_vertex_quats,     // these four may be 0
    const float* g_face_quats,
    const float* g_area_ratio,
    const float* g_vertex_area_ratio,
    float* at_vertices,  // [V, 8], scratch: by the sum of quaternions; by that of posed areas, of rest areas, 0
    float* rest_edges,   // [F, 8], scratch: by e1, 0, by e2, 0 as seen from corner 0; 0 if not wanted
    float* posed_edges,
    float* g_rest,  // [V, 3]; 0 if not wanted
    float* g_posed
) {
#pragma clang fp contract(fast)
#include "../runtime/ranges.h"
#include "vectors.h"
#include "face_vectors.h"
    if (g_vertex_quats || g_vertex_area_ratio)
        ranges(state, n_vertices, [&](int first, int end) {
            for (int i = first; i < end; i += 16) {
                const int count = wp::min(16, end - i);
                V4 g = {zero, zero, zero, zero};
                if (g_vertex_quats) {
                    const V length = get(sums + i, count);
                    const V4 q = get4(vertex_quats + 4ll * i, count);
                    g = get4(g_vertex_quats + 4ll * i, count);
                    g = scaled4(length > 0.f ? 1.f / length : zero, plus4(g, scaled4(-dot4(g, q), q)));
                }
                put4(at_vertices + 8ll * i, count, g, 8);
                if (g_vertex_area_ratio) {
                    const V area = get(sums + n_vertices + i, count);
                    const V by_posed = area > 0.f ? get(g_vertex_area_ratio + i, count) / area : zero;
                    const V by_rest = -get(vertex_area_ratio + i, count) * by_posed;
                    put4(at_vertices + 8ll * i + 4, count, {by_posed, by_rest, zero, zero}, 8);
                }
            }
        });

    const Table before = table3(rest_vertices, n_vertices), after = table3(posed_vertices, n_vertices);
    ranges(state + PHASE_WORDS, n_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
            const int* corners = corners_of(faces, i, count);
            const Pair p = pair(before, after, i, count, corners);
            const Triangle &r = p.rest, &o = p.posed;

            const V4 q = get4(face_quats + 4ll * i, count);
            V4 g = g_face_quats ? get4(g_face_quats + 4ll * i, count) : (V4){zero, zero, zero, zero};
            V g_weight = zero, by_posed = zero, by_rest = zero;  // with respect to areas
            const V3 sign = get3(signs + 3ll * i, g_vertex_quats ? count : 0);
            for (int k = 0; k < 3; k++) {
                auto from_corner = [&](const float* table) -> V4 {
                    return rows([&](int lane) -> Q { return load_row(table + 8ll * corners[3 * lane + k]); });
                };
                if (g_vertex_quats) {
                    V4 sum = from_corner(at_vertices);
                    sum = scaled4(k == 0 ? sign.x : k == 1 ? sign.y : sign.z, sum);
                    g = plus4(g, scaled4(p.weight, sum));
                    g_weight += dot4(sum, q);
                }
                if (g_vertex_area_ratio) {
                    const V4 sum = from_corner(at_vertices + 4);
                    by_posed += sum.w;
                    by_rest += sum.x;
                }
            }
            // A spin d of the rotation changes its quaternion by (0, d) q / 2.
            const V3 u = {q.x, q.y, q.z}, gu = {g.x, g.y, g.z};
            V3 omega = minus(minus(scaled(q.w, gu), scaled(g.w, u)), cross(gu, u));
            omega = choose(p.proper, scaled((V)(0.5f), omega), {zero, zero, zero});
            const V g_ratio = g_area_ratio ? get(g_area_ratio + i, count) : zero;
            const long long at = i;
#define PUT_EDGE(to, edge, ...) put4(to + 4 * edge, count, __VA_ARGS__, 8)
#include "edge_gradients.h"
        }
    });

    auto gather = [&](long long* progress, const float* edges, float* to) {
        if (to)
            ranges(progress, n_vertices, [&](int first, int end) {
                const float by_e1[3] = {-1.f, 1.f, 0.f}, by_e2[3] = {-1.f, 0.f, 1.f};
                for (int v = first; v < end; v++) {
                    Q total = (Q)(0.f);
                    for (int j = offsets[v]; j < offsets[v + 1]; j++) {
                        const unsigned f = (unsigned)corners[j] / 3u, k = (unsigned)corners[j] - 3u * f;
                        total += by_e1[k] * load_row(edges + 8ll * f) + by_e2[k] * load_row(edges + 8ll * f + 4);
                    }
                    memcpy(to + 3ll * v, &total, 3 * sizeof(float));
                }
            });
    };
    gather(state + 2 * PHASE_WORDS, rest_edges, g_rest);
    gather(state + 3 * PHASE_WORDS, posed_edges, g_posed);
}
