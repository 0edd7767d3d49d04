"""Float32 posing of Gaussians on the CPU: what `barycentric` computes, 16 Gaussians at once.

Backward, each Gaussian writes one row of eight for the vertices it rides on, (by position, by area ratio, by rotation),
and for each of its corners the weight of the second half; that of the first are its barycentrics. Then vertices add up
the rows, and faces the gradients of area ratios.
"""

from oasis_kernels.posing.posing_vectors import HEAD, fused
from oasis_kernels.runtime.native import PHASE_WORDS, native

COMMON = """
    auto product = [](V4 a, V4 b) -> V4 {
        return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
                a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
    };
    auto conjugate = [](V4 a) -> V4 { return {a.w, -a.x, -a.y, -a.z}; };
    auto growth = [&](V ratio, int half_powers) -> V {  // ratio^(half_powers / 2), the ratio bounded
        const V low = ratio > @LIMIT@ ? (V)(@LIMIT@) : ratio;
        const V r = low < 1.f / @LIMIT@ ? (V)(1.f / @LIMIT@) : low;
        return half_powers == 0 ? one : half_powers == 1 ? root(r) : r;
    };
    auto growth_slope = [&](V ratio, int half_powers) -> V {
        const V slope = 0.5f * (float)half_powers * growth(ratio, half_powers) / ratio;
        const I inside = (ratio >= 1.f / @LIMIT@) & (ratio <= @LIMIT@);
        return inside ? slope : zero;
    };
    int last_indices[16];
    auto indices_of = [&](const int* from, int count) -> const int* {
        if (count == 16) return from;
        memset(last_indices, 0, sizeof last_indices);
        memcpy(last_indices, from, count * sizeof(int));
        return last_indices;
    };
    const I lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    int gathered[48];
    auto corners_of = [&](const int* f) -> const int* {  // often the faces follow one another, as their corners do then
        if (__builtin_reduce_and(*(const IU*)f == f[0] + lanes)) return faces + 3ll * f[0];
        for (int lane = 0; lane < 16; lane++) memcpy(gathered + 3 * lane, faces + 3ll * f[lane], 3 * sizeof(int));
        return gathered;
    };
    auto pick = [&](const float* from, const int* index) -> V {
        V v;
        for (int lane = 0; lane < 16; lane++) v[lane] = from[index[lane]];
        return v;
    };
    auto get3_or_zero = [&](const float* p, long long i, int count) -> V3 {
        return p ? get3(p + 3 * i, count) : (V3){zero, zero, zero};
    };
    auto get4_or_zero = [&](const float* p, long long i, int count) -> V4 {
        return p ? get4(p + 4 * i, count) : (V4){zero, zero, zero, zero};
    };
"""

ON_VERTEX = """
            const int* v = indices_of(vertex_index + i, count);
            V4 q = rows([&](int lane) -> Q { return load_row(vertex_quats + 4ll * v[lane]); });
            const V length = root(dot4(q, q));
            const V per_length = length > 0.f ? 1.f / length : zero;
            q = scaled4(per_length, q);
            const V3 u = {q.x, q.y, q.z}, o = get3(offsets + 3ll * i, count), t = scaled((V)(2.f), cross(u, o));
            const V grown = growth(pick(vertex_area_ratio, v), half_powers);
"""

ON_FACE = """
            const long long at = n_on_vertices + (long long)i;
            const int* f = indices_of(face_index + i, count);
            const int* c = corners_of(f);
            const V3 b = get3(barycentrics + 3ll * i, count);
            V4 q[3];
            for (int k = 0; k < 3; k++)
                q[k] = rows([&](int lane) -> Q { return load_row(vertex_quats + 4ll * c[3 * lane + k]); });
            const I second = (b.y > b.x) & (b.y >= b.z), third = ~second & (b.z > b.x);
            const V4 reference = choose4(second, q[1], choose4(third, q[2], q[0]));
            auto aligned = [&](V4 a) -> V { return dot4(a, reference) < 0.f ? -one : one; };
            const V3 sign = {aligned(q[0]), aligned(q[1]), aligned(q[2])};
            const V4 rest = plus4(scaled4(b.y * sign.y, q[1]), scaled4(b.z * sign.z, q[2]));
            const V4 sum = plus4(scaled4(b.x * sign.x, q[0]), rest);
            const V length = root(dot4(sum, sum));
            const I mixed = length > 0.f;
            const V per_length = mixed ? 1.f / length : zero;
            const V4 turn = choose4(mixed, scaled4(per_length, sum), reference);
            const V ratio = pick(area_ratio, f), grown = growth(ratio, half_powers);
"""

POSE = """
    const Table table = table3(vertices, n_vertices);
    ranges(state, n_on_vertices, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
@ON_VERTEX@
            const V4 place = rows([&](int lane) -> Q { return at3(table, v[lane]); });
            const V3 shift = plus(o, plus(scaled(q.w, t), cross(u, t)));
            put3(means + 3ll * i, count, plus({place.w, place.x, place.y}, shift));
            put4(posed_quats + 4ll * i, count, product(q, get4(quats + 4ll * i, count)));
            put3(posed_scales + 3ll * i, count, scaled(grown, get3(scales + 3ll * i, count)));
        }
    });
    ranges(state + @PHASE_WORDS@, n_on_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
@ON_FACE@
            V3 mean = {zero, zero, zero};
            for (int k = 0; k < 3; k++) {
                const V4 p = rows([&](int lane) -> Q { return at3(table, c[3 * lane + k]); });
                mean = plus(mean, scaled(k == 0 ? b.x : k == 1 ? b.y : b.z, {p.w, p.x, p.y}));
            }
            put3(means + 3ll * at, count, mean);
            put4(posed_quats + 4ll * at, count, product(turn, get4(quats + 4ll * at, count)));
            put3(posed_scales + 3ll * at, count, scaled(grown, get3(scales + 3ll * at, count)));
        }
    });
"""

POSE_BACKWARD = """
    const Table table = table3(vertices, n_vertices);
    ranges(state, n_on_vertices, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
@ON_VERTEX@
            const V3 g_mean = get3_or_zero(g_means, i, count), g_scale = get3_or_zero(g_posed_scales, i, count);
            const V4 g_quat = get4_or_zero(g_posed_quats, i, count);
            if (g_offsets) {
                const V3 back = scaled((V)(2.f), cross(u, g_mean));
                put3(g_offsets + 3ll * i, count, plus(g_mean, minus(cross(u, back), scaled(q.w, back))));
            }
            if (g_quats) put4(g_quats + 4ll * i, count, product(conjugate(q), g_quat));
            if (g_scales) put3(g_scales + 3ll * i, count, scaled(grown, g_scale));
            if (rows_of_riders) {
                // Of u -> o + w t + u x t, which is the rotation for unit quaternions; then only what turns is kept.
                const V3 by_u = plus(scaled(2.f * q.w, cross(o, g_mean)),
                                     minus(plus(scaled(2.f * dot3(g_mean, u), o), scaled(2.f * dot3(u, o), g_mean)),
                                           scaled(4.f * dot3(g_mean, o), u)));
                V4 g = plus4(product(g_quat, conjugate(get4(quats + 4ll * i, count))),
                             {dot3(g_mean, t), by_u.x, by_u.y, by_u.z});
                g = scaled4(per_length, plus4(g, scaled4(-dot4(g, q), q)));
                const V slope = growth_slope(pick(vertex_area_ratio, v), half_powers);
                const V by_area = slope * dot3(g_scale, get3(scales + 3ll * i, count));
                put4(rows_of_riders + 8ll * i, count, {g_mean.x, g_mean.y, g_mean.z, by_area}, 8);
                put4(rows_of_riders + 8ll * i + 4, count, g, 8);
            }
        }
    });
    ranges(state + @PHASE_WORDS@, n_on_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
@ON_FACE@
            const V3 g_mean = get3_or_zero(g_means, at, count), g_scale = get3_or_zero(g_posed_scales, at, count);
            const V4 g_quat = get4_or_zero(g_posed_quats, at, count);
            if (g_quats) put4(g_quats + 4ll * at, count, product(conjugate(turn), g_quat));
            if (g_scales) put3(g_scales + 3ll * at, count, scaled(grown, g_scale));
            if (by_ratio) {
                const V slope = growth_slope(ratio, half_powers);
                put(by_ratio + i, count, slope * dot3(g_scale, get3(scales + 3ll * at, count)));
            }
            if (rows_of_riders || g_barycentrics) {
                V4 g = product(g_quat, conjugate(get4(quats + 4ll * at, count)));
                g = scaled4(per_length, plus4(g, scaled4(-dot4(g, turn), turn)));
                if (rows_of_riders) {
                    put4(rows_of_riders + 8ll * at, count, {g_mean.x, g_mean.y, g_mean.z, zero}, 8);
                    put4(rows_of_riders + 8ll * at + 4, count, g, 8);
                    put3(weights + 3ll * i, count, {b.x * sign.x, b.y * sign.y, b.z * sign.z});
                }
                if (g_barycentrics) {
                    V by[3];
                    for (int k = 0; k < 3; k++) {
                        const V4 p = rows([&](int lane) -> Q { return at3(table, c[3 * lane + k]); });
                        const V turn_sign = k == 0 ? sign.x : k == 1 ? sign.y : sign.z;
                        by[k] = dot3(g_mean, {p.w, p.x, p.y}) + turn_sign * dot4(g, q[k]);
                    }
                    put3(g_barycentrics + 3ll * i, count, {by[0], by[1], by[2]});
                }
            }
        }
    });

    // A vertex's places: 0 .. n - 1 are Gaussians on it, n + 3 i + k is the corner k of Gaussian n + i.
    const bool wanted = g_vertices || g_vertex_quats || g_vertex_area_ratio;
    if (wanted) ranges(state + 2 * @PHASE_WORDS@, n_vertices, [&](int first, int end) {
        for (int v = first; v < end; v++) {
            Q low = (Q)(0.f), high = (Q)(0.f);  // by position and area ratio; by rotation
            for (int j = vertex_starts[v]; j < vertex_starts[v + 1]; j++) {
                const unsigned place = (unsigned)places[j];
                const bool corner = place >= (unsigned)n_on_vertices;
                const unsigned at = place - (unsigned)n_on_vertices;
                const float* row = rows_of_riders + 8ll * (corner ? (unsigned)n_on_vertices + at / 3u : place);
                low += (corner ? barycentrics[at] : 1.f) * load_row(row);
                high += (corner ? weights[at] : 1.f) * load_row(row + 4);
            }
            if (g_vertices) memcpy(g_vertices + 3ll * v, &low, 3 * sizeof(float));
            if (g_vertex_quats) store_row(g_vertex_quats + 4ll * v, high);
            if (g_vertex_area_ratio) g_vertex_area_ratio[v] = low.w;
        }
    });
    if (g_area_ratio) ranges(state + 3 * @PHASE_WORDS@, n_faces, [&](int first, int end) {
        for (int f = first; f < end; f++) {
            float total = 0.f;
            for (int j = face_starts[f]; j < face_starts[f + 1]; j++) total += by_ratio[riders[j]];
            g_area_ratio[f] = total;
        }
    });
"""

INPUTS = {
    "n_vertices": "int",
    "n_faces": "int",
    "n_on_vertices": "int",  # P
    "n_on_faces": "int",  # Q
    "half_powers": "int",
    "vertices": "const float*",  # [V, 3]
    "faces": "const int*",  # [F, 3]
    "vertex_index": "const int*",  # [P]
    "face_index": "const int*",  # [Q]
    "barycentrics": "const float*",  # [Q, 3]
    "vertex_quats": "const float*",  # [V, 4]
    "area_ratio": "const float*",  # [F]
    "vertex_area_ratio": "const float*",  # [V]
    "offsets": "const float*",  # [P, 3]
    "quats": "const float*",  # [P + Q, 4]
    "scales": "const float*",  # [P + Q, 3]
    "state": "long long*",  # `STATE` words of zeros
}
STATE = 4 * PHASE_WORDS
"""Words that threads share."""


def _expanded(body: str) -> str:
    names = {"ON_VERTEX": ON_VERTEX, "ON_FACE": ON_FACE, "LIMIT": "1e4f", "PHASE_WORDS": PHASE_WORDS}
    for name, value in names.items():
        body = body.replace(f"@{name}@", str(value))
    return fused(HEAD + body)


pose = native(
    "pose",
    INPUTS
    | {
        "means": "float*",  # [P + Q, 3]
        "posed_quats": "float*",  # [P + Q, 4]
        "posed_scales": "float*",  # [P + Q, 3]
    },
    _expanded(COMMON + POSE),
)
pose_backward = native(
    "pose_backward",
    INPUTS
    | {
        "g_means": "const float*",  # these three may be 0
        "g_posed_quats": "const float*",
        "g_posed_scales": "const float*",
        "vertex_starts": "const int*",  # [V + 1]; of `places`, for each vertex
        "places": "const int*",  # [P + 3 Q]; i < P: the Gaussian i on a vertex; P + 3 i + k: corner k of Gaussian P + i
        "face_starts": "const int*",  # [F + 1]; of `riders`, for each face
        "riders": "const int*",  # [Q]
        "rows_of_riders": "float*",  # [P + Q, 8], scratch; 0 if nothing of vertices is wanted, or nothing rides
        "weights": "float*",  # [Q, 3], scratch, with the rows
        "by_ratio": "float*",  # [Q], scratch; 0 if area ratios are not wanted
        "g_vertices": "float*",  # each of these is 0 if not wanted
        "g_barycentrics": "float*",
        "g_vertex_quats": "float*",
        "g_area_ratio": "float*",
        "g_quats": "float*",
        "g_scales": "float*",
        "g_offsets": "float*",
        "g_vertex_area_ratio": "float*",
    },
    _expanded(COMMON + POSE_BACKWARD),
)
