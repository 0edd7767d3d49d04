"""Float32 face and vertex rotations on the CPU: what `face_rotation` computes, 16 faces or vertices at once.

Float32 suffices for triangles of any unit of length: each is first scaled by a power of two, so that its largest edge
component lies in [1, 2), and seen from the corner where its longest rest edge begins: in the frame (t, b, n) with t
along that edge, e1 = l t and e2 = x t + y b with y >= 0. Edges from 1e-18 to 1e15 have areas that float32 can hold;
shorter ones count as flat.

The turn in the plane has the cosine c = l' y + l y' and the sine s = l' x - l x' over h = hypot(c, s). So R t = t" and
R b = b" with t" = c t' + s b', b" = c b' - s t', and h is also the trace of the stretch that divides the gradient of
the angle: all that `face_rotation.turn_gradient` needs is at hand in the two frames.
"""

from oasis_kernels.posing.posing_vectors import HEAD, fused
from oasis_kernels.runtime.native import PHASE_WORDS, native

TRIANGLE = 12
"""Numbers of a face at rest in the table of `measure`."""

GEOMETRY = """
    struct Triangle { V3 t, b, n; V l, x, y, longest, scale, unit; I flat, point; };
    const I mantissa_off = (I)(0x7f800000), inverse = (I)(0x7f000000);
    struct Edges { V3 a, b, c; V scale, unit; };
    auto edges = [&](const Table& vertices, const int* corners) -> Edges {
        V3 p[3];
        for (int k = 0; k < 3; k++) {
            const V4 v = rows([&](int lane) -> Q { return at3(vertices, corners[3 * lane + k]); });
            p[k] = {v.w, v.x, v.y};
        }
        Edges e = {minus(p[1], p[0]), minus(p[2], p[1]), minus(p[0], p[2])};
        auto size = [&](V3 s) -> V { return largest(magnitude(s.x), largest(magnitude(s.y), magnitude(s.z))); };
        const V most = largest((V)(1e-30f), largest(size(e.a), largest(size(e.b), size(e.c))));
        const I power = __builtin_bit_cast(I, most) & mantissa_off;
        e.unit = __builtin_bit_cast(V, power);
        e.scale = __builtin_bit_cast(V, inverse - power);
        e.a = scaled(e.scale, e.a);
        e.b = scaled(e.scale, e.b);
        e.c = scaled(e.scale, e.c);
        return e;
    };
    struct Start { I a, b; };  // whether the longest edge is a, b, else c
    auto start = [&](const Edges& e) -> Start {
        const V la = dot3(e.a, e.a), lb = dot3(e.b, e.b), lc = dot3(e.c, e.c);
        const I a = (la >= lb) & (la >= lc);
        return {a, ~a & (lb >= lc)};
    };
    auto completed = [&](Triangle o) -> Triangle {
        o.point = !(o.longest > 0.f);
        o.n = cross(o.t, o.b);
        o.flat = !(o.l * o.y > @FLAT@ * o.longest);
        return o;
    };
    auto triangle = [&](const Edges& e, const Start& from) -> Triangle {
        Triangle o;
        const V3 e1 = choose(from.a, e.a, choose(from.b, e.b, e.c));
        const V3 e3 = choose(from.a, e.c, choose(from.b, e.a, e.b));  // comes back to the corner
        const V3 e2 = scaled((V)(-1.f), e3);
        o.longest = largest(dot3(e.a, e.a), largest(dot3(e.b, e.b), dot3(e.c, e.c)));
        o.l = root(dot3(e1, e1));
        o.t = scaled(o.l > 0.f ? 1.f / o.l : zero, e1);
        o.x = dot3(e2, o.t);
        const V3 height = minus(e2, scaled(o.x, o.t));
        o.y = root(dot3(height, height));
        o.b = scaled(o.y > 0.f ? 1.f / o.y : zero, height);
        o.scale = e.scale;
        o.unit = e.unit;
        return completed(o);
    };
    auto at_rest = [&](const Table& vertices, int first, int count, const int* corners, Start& from) -> Triangle {
        if (!triangles) {
            const Edges e = edges(vertices, corners);
            from = start(e);
            return triangle(e, from);
        }
        auto part = [&](int k) -> V4 {
            return rows([&](int lane) -> Q {
                return load_row(triangles + @TRIANGLE@ll * (first + wp::min(lane, count - 1)) + 4 * k);
            });
        };
        const V4 p = part(0), q = part(1), r = part(2);
        Triangle o;
        o.t = {p.w, p.x, p.y};
        o.l = p.z;
        o.b = {q.w, q.x, q.y};
        o.x = q.z;
        o.y = r.w;
        o.longest = r.x;
        o.unit = r.y;
        o.scale = __builtin_bit_cast(V, inverse - __builtin_bit_cast(I, o.unit));
        from = {r.z == 0.f, r.z == 1.f};
        return completed(o);
    };
    struct Pair { Triangle rest, posed; Start from; I proper; V weight, damped, ratio, c, s, h; V3 t, b; };
    auto pair = [&](const Table& before, const Table& after, int first, int count, const int* corners) -> Pair {
        Pair o;
        const Triangle rest = at_rest(before, first, count, corners, o.from);
        const Triangle posed = triangle(edges(after, corners), o.from);
        o.rest = rest;
        o.posed = posed;
        o.weight = 0.5f * rest.l * rest.y * rest.unit * rest.unit;
        o.proper = ~rest.flat & ~posed.flat & (o.weight > 0.f);
        o.weight = o.proper ? o.weight : zero;
        const V damping = @DAMPING@ * rest.longest;
        const V larger = rest.scale * posed.unit;  // of the posed scale; bounded, for its square to be finite
        const V growth = larger < 0x1p60f ? larger : (V)(0x1p60f);
        const V damped = 0.5f * rest.l * rest.y + damping;
        const V grown = 0.5f * posed.l * posed.y * growth * growth + damping;
        o.ratio = rest.point ? one : grown / damped;
        o.damped = damped;
        o.c = posed.l * rest.y + rest.l * posed.y;
        o.s = posed.l * rest.x - rest.l * posed.x;
        o.h = root(o.c * o.c + o.s * o.s);
        const V per = o.proper ? 1.f / o.h : zero;
        o.c *= per;
        o.s *= per;
        o.t = plus(scaled(o.c, posed.t), scaled(o.s, posed.b));
        o.b = minus(scaled(o.c, posed.b), scaled(o.s, posed.t));
        return o;
    };
    int last_corners[48];
    auto corners_of = [&](const int* faces, int first, int count) -> const int* {
        const int* corners = faces + 3ll * first;
        if (count == 16) return corners;
        memset(last_corners, 0, sizeof last_corners);
        memcpy(last_corners, corners, 3 * count * sizeof(int));
        return last_corners;
    };
"""

MEASURE = """
    const float* triangles = nullptr;
""" + GEOMETRY + """
    const Table vertices = table3(rest_vertices, n_vertices);
    ranges(state, n_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
            Start from;
            const Triangle o = at_rest(vertices, i, count, corners_of(faces, i, count), from);
            const V begins = from.a ? zero : from.b ? one : (V)(2.f);
            float* row = out + @TRIANGLE@ll * i;
            put4(row, count, {o.t.x, o.t.y, o.t.z, o.l}, @TRIANGLE@);
            put4(row + 4, count, {o.b.x, o.b.y, o.b.z, o.x}, @TRIANGLE@);
            put4(row + 8, count, {o.y, o.longest, o.unit, begins}, @TRIANGLE@);
        }
    });
"""

TURN = """
    const Table before = table3(rest_vertices, n_vertices), after = table3(posed_vertices, n_vertices);
    long long* found_flat = state + @FLAT_WORD@;
    ranges(state, n_faces, [&](int first, int end) {
        for (int i = first; i < end; i += 16) {
            const int count = wp::min(16, end - i);
            const Pair p = pair(before, after, i, count, corners_of(faces, i, count));
            const V3 t = p.rest.t, b = p.rest.b, n = p.rest.n, n1 = p.posed.n;
            auto entry = [&](V u, V v, V w, V x, V y, V z) -> V { return u * x + v * y + w * z; };
            const V m00 = entry(p.t.x, p.b.x, n1.x, t.x, b.x, n.x), m01 = entry(p.t.x, p.b.x, n1.x, t.y, b.y, n.y);
            const V m02 = entry(p.t.x, p.b.x, n1.x, t.z, b.z, n.z), m10 = entry(p.t.y, p.b.y, n1.y, t.x, b.x, n.x);
            const V m11 = entry(p.t.y, p.b.y, n1.y, t.y, b.y, n.y), m12 = entry(p.t.y, p.b.y, n1.y, t.z, b.z, n.z);
            const V m20 = entry(p.t.z, p.b.z, n1.z, t.x, b.x, n.x), m21 = entry(p.t.z, p.b.z, n1.z, t.y, b.y, n.y);
            const V m22 = entry(p.t.z, p.b.z, n1.z, t.z, b.z, n.z);
            // The largest component first (Shepperd 1978).
            const V trace = m00 + m11 + m22;
            const I w = (trace >= m00) & (trace >= m11) & (trace >= m22), x = ~w & (m00 >= m11) & (m00 >= m22);
            const I y = ~w & ~x & (m11 >= m22);
            const V wx = m21 - m12, wy = m02 - m20, wz = m10 - m01, xy = m01 + m10, xz = m02 + m20, yz = m12 + m21;
            V4 q = {w ? 1.f + trace : x ? wx : y ? wy : wz, w ? wx : x ? 1.f + m00 - m11 - m22 : y ? xy : xz,
                    w ? wy : x ? xy : y ? 1.f - m00 + m11 - m22 : yz,
                    w ? wz : x ? xz : y ? yz : 1.f - m00 - m11 + m22};
            const V length = 1.f / root(dot4(q, q));
            q = choose4(p.proper, scaled4(q.w < 0.f ? -length : length, q), {one, zero, zero, zero});
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
            for (int f = 0; f < n_faces; f++) if (rows_of_faces[8ll * f + 4] > most) {
                most = rows_of_faces[8ll * f + 4];
                known = f;
            }
        }
        return n_faces ? load_row(face_quats + 4ll * known) : (Q){1.f, 0.f, 0.f, 0.f};
    };
    const int KEPT = 16;  // corners of a vertex whose rows stay at hand for the second look
    ranges(state + @PHASE_WORDS@, n_vertices, [&](int first, int end) {
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
                if (signs) for (int lane = 0; lane < count; lane++) if (j <= lasts[lane])
                    signs[corners[begins[lane] + j]] = sign[lane];
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
    if (patch) ranges(state + 2 * @PHASE_WORDS@, n_faces, [&](int first, int end) {
        for (int f = first; f < end; f++) if (!(rows_of_faces[8ll * f + 4] > 0.f)) {
            const Q other = fallback();
            store_row(face_quats + 4ll * f, other);
        }
    });
"""

TURN_BACKWARD = """
    if (g_vertex_quats || g_vertex_area_ratio) ranges(state, n_vertices, [&](int first, int end) {
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
    ranges(state + @PHASE_WORDS@, n_faces, [&](int first, int end) {
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
            const V per_trace = p.proper ? 1.f / p.h : zero;

            const V g_ratio = g_area_ratio ? get(g_area_ratio + i, count) : zero;
            const V per_area = r.point ? zero : g_ratio * r.scale * r.scale / p.damped;
            by_posed += per_area;
            by_rest -= p.ratio * per_area;
            const V by_damping = by_posed + by_rest;
            by_rest += p.proper ? g_weight : zero;

            // By e1 and e2 of one triangle: its tilt, its spin over the other's edges o1, o2, its area, its damping.
            auto edge_gradients = [&](const Triangle& m, V3 w, V3 o1, V3 o2, V by_area, V by_longest, V3& g1, V3& g2) {
                const V per_y = m.flat ? zero : 1.f / m.y, per_l = m.flat ? zero : 1.f / m.l;
                const V wt = dot3(w, m.t), wb = dot3(w, m.b), spin = dot3(w, m.n) * per_trace;
                const V area = m.flat ? zero : 0.5f * by_area * m.unit;
                g1 = plus(scaled(-(m.x * wt * per_y + wb) * per_l, m.n), scaled(spin, o2));
                g2 = minus(scaled(wt * per_y, m.n), scaled(spin, o1));
                g1 = plus(scaled(m.scale, g1), scaled(area, minus(scaled(m.y, m.t), scaled(m.x, m.b))));
                g1 = plus(g1, scaled(2.f * by_longest * m.unit * m.l, m.t));
                g2 = plus(scaled(m.scale, g2), scaled(area * m.l, m.b));
            };
            // From the corner where the longest edge begins to corner 0.
            auto store_edges = [&](float* to, V3 g1, V3 g2) {
                const Start& from = p.from;
                const V3 g0 = scaled((V)(-1.f), plus(g1, g2));
                const V3 by_e1 = choose(from.a, g1, choose(from.b, g0, g2));
                const V3 by_e2 = choose(from.a, g2, choose(from.b, g1, g0));
                put4(to, count, {by_e1.x, by_e1.y, by_e1.z, zero}, 8);
                put4(to + 4, count, {by_e2.x, by_e2.y, by_e2.z, zero}, 8);
            };
            V3 g1, g2;
            if (posed_edges) {
                const V3 o1 = scaled(r.l, p.t), o2 = plus(scaled(r.x, p.t), scaled(r.y, p.b));
                edge_gradients(o, omega, o1, o2, by_posed, zero, g1, g2);
                store_edges(posed_edges + 8ll * i, g1, g2);
            }
            if (rest_edges) {
                const V3 back = {-dot3(omega, p.t), -dot3(omega, p.b), -dot3(omega, o.n)};
                const V3 w = plus(scaled(back.x, r.t), plus(scaled(back.y, r.b), scaled(back.z, r.n)));
                const V3 t = minus(scaled(p.c, r.t), scaled(p.s, r.b));  // posed t and b, turned back
                const V3 b = plus(scaled(p.s, r.t), scaled(p.c, r.b));
                const V3 o1 = scaled(o.l, t), o2 = plus(scaled(o.x, t), scaled(o.y, b));
                edge_gradients(r, w, o1, o2, by_rest, @DAMPING@ * by_damping, g1, g2);
                store_edges(rest_edges + 8ll * i, g1, g2);
            }
        }
    });

    auto gather = [&](long long* progress, const float* edges, float* to) {
        if (to) ranges(progress, n_vertices, [&](int first, int end) {
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
    gather(state + 2 * @PHASE_WORDS@, rest_edges, g_rest);
    gather(state + 3 * @PHASE_WORDS@, posed_edges, g_posed);
"""

FACES = {
    "n_vertices": "int",
    "n_faces": "int",
    "rest_vertices": "const float*",  # [V, 3]
    "faces": "const int*",  # [F, 3]
    "state": "long long*",  # `STATE` words of zeros
}
MESHES = FACES | {
    "triangles": "const float*",  # [F, TRIANGLE], from `measure`, or 0
    "posed_vertices": "const float*",  # [V, 3]
    "offsets": "const int*",  # [V + 1]; corners of vertex v are corners[offsets[v] .. offsets[v + 1] - 1]
    "corners": "const int*",  # [3 F]; 3 face + corner
}
STATE = 4 * PHASE_WORDS
"""Words that threads share."""


def _expanded(body: str) -> str:
    names = {"FLAT": "1e-6f", "DAMPING": "0.5e-6f", "PHASE_WORDS": PHASE_WORDS, "FLAT_WORD": 3 * PHASE_WORDS}
    names["TRIANGLE"] = TRIANGLE
    for name, value in names.items():
        body = body.replace(f"@{name}@", str(value))
    return fused(HEAD + body)


measure = native("measure", FACES | {"out": "float*"}, _expanded(MEASURE))  # [F, TRIANGLE]
turn = native(
    "turn",
    MESHES
    | {
        "rows_of_faces": "float*",  # [F, 8], scratch: weight times quaternion; weight, damped rest and posed area, 0
        "vertex_quats": "float*",  # [V, 4]
        "face_quats": "float*",  # [F, 4]
        "area_ratio": "float*",  # [F]
        "vertex_area_ratio": "float*",  # [V]
        "signs": "float*",  # [F, 3] or 0: what each corner's quaternion counted with
        "sums": "float*",  # [2, V] or 0: length of the sum before it was normalised; rest areas
    },
    _expanded(GEOMETRY + TURN),
)
turn_backward = native(
    "turn_backward",
    MESHES
    | {
        "vertex_quats": "const float*",
        "face_quats": "const float*",
        "vertex_area_ratio": "const float*",
        "signs": "const float*",
        "sums": "const float*",
        "g_vertex_quats": "const float*",  # these four may be 0
        "g_face_quats": "const float*",
        "g_area_ratio": "const float*",
        "g_vertex_area_ratio": "const float*",
        "at_vertices": "float*",  # [V, 8], scratch: by the sum of quaternions; by that of posed areas, of rest areas, 0
        "rest_edges": "float*",  # [F, 8], scratch: by e1, 0, by e2, 0 as seen from corner 0; 0 if not wanted
        "posed_edges": "float*",
        "g_rest": "float*",  # [V, 3]; 0 if not wanted
        "g_posed": "float*",
    },
    _expanded(GEOMETRY + TURN_BACKWARD),
)
