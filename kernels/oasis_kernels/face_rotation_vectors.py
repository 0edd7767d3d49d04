"""Float32 face and vertex rotations on the CPU: what `face_rotation` computes, 16 faces or vertices at once.

`faces` -> `vertices`; backward `vertices_backward` -> `faces_backward` -> `gather_edges` (one for either mesh).

Float32 suffices for triangles of any unit of length: each is first scaled by a power of two, so that its largest edge
component lies in [1, 2), and seen from the corner where its longest rest edge begins: in the frame (t, b, n) with t
along that edge, e1 = l t and e2 = x t + y b with y >= 0. Edges from 1e-18 to 1e15 have areas that float32 can hold;
shorter ones count as flat.

The turn in the plane has the cosine c = l' y + l y' and the sine s = l' x - l x' over h = hypot(c, s). So R t = t" and
R b = b" with t" = c t' + s b', b" = c b' - s t', and h is also the trace of the stretch that divides the gradient of
the angle: all that `face_rotation.turn_gradient` needs is at hand in the two frames.

Scratch of `faces` for `vertices`: `areas`, a row a face of (weight, damped rest area, damped posed area, 0), and
`weighted`, quaternion times weight.
"""

from oasis_kernels.posing_vectors import kernel

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
    auto triangle = [&](const Edges& e, const Start& from) -> Triangle {
        Triangle o;
        const V3 e1 = choose(from.a, e.a, choose(from.b, e.b, e.c));
        const V3 e3 = choose(from.a, e.c, choose(from.b, e.a, e.b));  // comes back to the corner
        const V3 e2 = scaled((V)(-1.f), e3);
        o.longest = largest(dot3(e.a, e.a), largest(dot3(e.b, e.b), dot3(e.c, e.c)));
        o.point = !(o.longest > 0.f);
        o.l = root(dot3(e1, e1));
        o.t = scaled(o.l > 0.f ? 1.f / o.l : zero, e1);
        o.x = dot3(e2, o.t);
        const V3 height = minus(e2, scaled(o.x, o.t));
        o.y = root(dot3(height, height));
        o.b = scaled(o.y > 0.f ? 1.f / o.y : zero, height);
        o.n = cross(o.t, o.b);
        o.flat = !(o.l * o.y > @FLAT@ * o.longest);
        o.scale = e.scale;
        o.unit = e.unit;
        return o;
    };
    struct Pair { Triangle rest, posed; Start from; I proper; V weight, damped, ratio, c, s, h; V3 t, b; };
    auto pair = [&](const Table& rest_vertices, const Table& posed_vertices, const int* corners) -> Pair {
        Pair o;
        const Edges before = edges(rest_vertices, corners), after = edges(posed_vertices, corners);
        const Start from = start(before);
        const Triangle rest = triangle(before, from), posed = triangle(after, from);
        o.from = from;
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

FACES = """
    const Table rest = table3(floats(0), (int)block[3]), posed = table3(floats(1), (int)block[3]);
    const int* faces = ints(2);
    float *quats = floats(4), *ratios = floats(5), *areas = floats(6), *weighted = floats(7);
    for (int i = first; i < end; i += 16) {
        const int count = wp::min(16, end - i);
        const Pair p = pair(rest, posed, corners_of(faces, i, count));
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
                w ? wy : x ? xy : y ? 1.f - m00 + m11 - m22 : yz, w ? wz : x ? xz : y ? yz : 1.f - m00 - m11 + m22};
        const V length = 1.f / root(dot4(q, q));
        q = choose4(p.proper, scaled4(q.w < 0.f ? -length : length, q), {one, zero, zero, zero});
        const V square = p.rest.unit * p.rest.unit;
        put4(quats + 4ll * i, count, q);
        put(ratios + i, count, p.ratio);
        put4(areas + 4ll * i, count, {p.weight, p.damped * square, p.ratio * p.damped * square, zero});
        put4(weighted + 4ll * i, count, scaled4(p.weight, q));
    }
"""

VERTICES = """
    const int KEPT = 16;  // corners of a vertex whose rows stay at hand for the second look
    const int n_faces = (int)block[0];
    const int *offsets = ints(1), *corners = ints(2);
    float *face_quats = floats(3), *areas = floats(4), *weighted = floats(5);
    float *quats = floats(6), *ratios = floats(7), *signs = floats(8), *sums = floats(9);

    // What has no rotation of its own gets that of the largest face, so that a rigid motion still acts rigidly.
    int known = -1;
    auto fallback = [&]() -> Q {
        if (known < 0) {
            float most = 0.f;
            known = 0;
            for (int f = 0; f < n_faces; f++) if (areas[4ll * f] > most) {
                most = areas[4ll * f];
                known = f;
            }
        }
        return n_faces ? load_row(face_quats + 4ll * known) : (Q){1.f, 0.f, 0.f, 0.f};
    };

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
            return rows([&](int lane) -> Q { return load_row(table + 4ll * here[lane]); });
        };
        auto look = [&](int j) {
            for (int lane = 0; lane < 16; lane++)
                here[lane] = (unsigned)corners[begins[lane] + wp::max(wp::min(j, lasts[lane]), 0)] / 3u;
        };
        V heaviest = zero, rest = zero, posed = zero;
        V4 reference = {zero, zero, zero, zero}, total = reference, kept[KEPT];
        for (int j = 0; j < most; j++) {
            look(j);
            const I there = j <= last;
            const V4 a = gather(areas), q = gather(weighted);
            if (j < KEPT) kept[j] = q;
            rest += there ? a.x : zero;
            posed += there ? a.y : zero;
            const I better = there & (a.w > heaviest);
            heaviest = better ? a.w : heaviest;
            reference = choose4(better, q, reference);
        }
        reference = scaled4(heaviest > 0.f ? 1.f / heaviest : zero, reference);
        for (int j = 0; j < most; j++) {
            if (j >= KEPT) look(j);
            const V4 q = j < KEPT ? kept[j] : gather(weighted);
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
        put4(quats + 4ll * i, count, q);
        put(ratios + i, count, rest > 0.f ? posed / rest : one);
        if (sums) {
            put(sums + i, count, turned ? length * heaviest : zero);
            put(sums + block[10] + i, count, rest);
        }
    }
    if (first == 0) for (int f = 0; f < n_faces; f++) if (!(areas[4ll * f] > 0.f)) {
        store_row(face_quats + 4ll * f, fallback());
    }
"""

VERTICES_BACKWARD = """
    const float *quats = floats(0), *ratios = floats(1), *sums = floats(2), *rests = sums + block[3];
    const float *g_quats = floats(4), *g_ratios = floats(5);
    float* out = floats(6);  // a row of eight: with respect to the sum of quaternions; to that of posed and rest areas
    for (int i = first; i < end; i += 16) {
        const int count = wp::min(16, end - i);
        V4 g = {zero, zero, zero, zero};
        if (g_quats) {
            const V length = get(sums + i, count);
            const V4 q = get4(quats + 4ll * i, count);
            g = get4(g_quats + 4ll * i, count);
            g = scaled4(length > 0.f ? 1.f / length : zero, plus4(g, scaled4(-dot4(g, q), q)));
        }
        put4(out + 8ll * i, count, g, 8);
        if (g_ratios) {
            const V rest = get(rests + i, count), by_posed = rest > 0.f ? get(g_ratios + i, count) / rest : zero;
            put4(out + 8ll * i + 4, count, {by_posed, -get(ratios + i, count) * by_posed, zero, zero}, 8);
        }
    }
"""

FACES_BACKWARD = """
    const Table rest_vertices = table3(floats(0), (int)block[3]), posed_vertices = table3(floats(1), (int)block[3]);
    const int* faces = ints(2);
    const float *quats = floats(4), *signs = floats(5), *at_vertices = floats(6), *g_quats = floats(7);
    const float* g_ratios = floats(8);
    const bool turns = block[9], grows = block[10];  // which halves of `at_vertices` are there
    float *g_rest = floats(11), *g_posed = floats(12);  // a row of eight: by e1, 0, by e2, 0 as seen from corner 0
    for (int i = first; i < end; i += 16) {
        const int count = wp::min(16, end - i);
        const int* corners = corners_of(faces, i, count);
        const Pair p = pair(rest_vertices, posed_vertices, corners);
        const Triangle &rest = p.rest, &posed = p.posed;

        const V4 q = get4(quats + 4ll * i, count);
        V4 g = g_quats ? get4(g_quats + 4ll * i, count) : (V4){zero, zero, zero, zero};
        V g_weight = zero, by_posed = zero, by_rest = zero;  // with respect to areas
        const V3 sign = get3(signs + 3ll * i, turns ? count : 0);
        for (int k = 0; k < 3; k++) {
            if (turns) {
                V4 sum = rows([&](int lane) -> Q { return load_row(at_vertices + 8ll * corners[3 * lane + k]); });
                sum = scaled4(k == 0 ? sign.x : k == 1 ? sign.y : sign.z, sum);
                g = plus4(g, scaled4(p.weight, sum));
                g_weight += dot4(sum, q);
            }
            if (grows) {
                const V4 sum = rows([&](int lane) -> Q { return load_row(at_vertices + 8ll * corners[3 * lane + k] + 4); });
                by_posed += sum.w;
                by_rest += sum.x;
            }
        }
        // A spin d of the rotation changes its quaternion by (0, d) q / 2.
        const V3 u = {q.x, q.y, q.z}, gu = {g.x, g.y, g.z};
        V3 omega = minus(minus(scaled(q.w, gu), scaled(g.w, u)), cross(gu, u));
        omega = choose(p.proper, scaled((V)(0.5f), omega), {zero, zero, zero});
        const V per_trace = p.proper ? 1.f / p.h : zero;

        const V g_ratio = g_ratios ? get(g_ratios + i, count) : zero;
        const V per_area = rest.point ? zero : g_ratio * rest.scale * rest.scale / p.damped;
        by_posed += per_area;
        by_rest -= p.ratio * per_area;
        const V by_damping = by_posed + by_rest;
        by_rest += p.proper ? g_weight : zero;

        // By e1 and e2 of one triangle: its tilt, its spin over the other's edges o1, o2, its area, its damping.
        auto edge_gradients = [&](const Triangle& o, V3 w, V3 o1, V3 o2, V by_area, V by_longest, V3& g1, V3& g2) {
            const V per_y = o.flat ? zero : 1.f / o.y, per_l = o.flat ? zero : 1.f / o.l;
            const V wt = dot3(w, o.t), wb = dot3(w, o.b), spin = dot3(w, o.n) * per_trace;
            const V area = o.flat ? zero : 0.5f * by_area * o.unit;
            g1 = plus(scaled(-(o.x * wt * per_y + wb) * per_l, o.n), scaled(spin, o2));
            g2 = minus(scaled(wt * per_y, o.n), scaled(spin, o1));
            g1 = plus(scaled(o.scale, g1), scaled(area, minus(scaled(o.y, o.t), scaled(o.x, o.b))));
            g1 = plus(g1, scaled(2.f * by_longest * o.unit * o.l, o.t));
            g2 = plus(scaled(o.scale, g2), scaled(area * o.l, o.b));
        };
        auto store_edges = [&](float* out, V3 g1, V3 g2) {  // from the corner where the longest edge begins to corner 0
            const Start& from = p.from;
            const V3 g0 = scaled((V)(-1.f), plus(g1, g2));
            const V3 by_e1 = choose(from.a, g1, choose(from.b, g0, g2));
            const V3 by_e2 = choose(from.a, g2, choose(from.b, g1, g0));
            put4(out, count, {by_e1.x, by_e1.y, by_e1.z, zero}, 8);
            put4(out + 4, count, {by_e2.x, by_e2.y, by_e2.z, zero}, 8);
        };
        V3 g1, g2;
        if (g_posed) {
            const V3 o1 = scaled(rest.l, p.t), o2 = plus(scaled(rest.x, p.t), scaled(rest.y, p.b));
            edge_gradients(posed, omega, o1, o2, by_posed, zero, g1, g2);
            store_edges(g_posed + 8ll * i, g1, g2);
        }
        if (g_rest) {
            const V3 back = {-dot3(omega, p.t), -dot3(omega, p.b), -dot3(omega, posed.n)};
            const V3 w = plus(scaled(back.x, rest.t), plus(scaled(back.y, rest.b), scaled(back.z, rest.n)));
            const V3 t = minus(scaled(p.c, rest.t), scaled(p.s, rest.b));  // posed t and b, turned back
            const V3 b = plus(scaled(p.s, rest.t), scaled(p.c, rest.b));
            const V3 o1 = scaled(posed.l, t), o2 = plus(scaled(posed.x, t), scaled(posed.y, b));
            edge_gradients(rest, w, o1, o2, by_rest, @DAMPING@ * by_damping, g1, g2);
            store_edges(g_rest + 8ll * i, g1, g2);
        }
    }
"""

GATHER_EDGES = """
    const int *offsets = ints(0), *corners = ints(1);
    const float* edges = floats(2);
    float* out = floats(3);
    const float by_e1[3] = {-1.f, 1.f, 0.f}, by_e2[3] = {-1.f, 0.f, 1.f};
    for (int v = first; v < end; v++) {
        Q total = (Q)(0.f);
        for (int j = offsets[v]; j < offsets[v + 1]; j++) {
            const unsigned f = (unsigned)corners[j] / 3u, k = (unsigned)corners[j] - 3u * f;
            total += by_e1[k] * load_row(edges + 8ll * f) + by_e2[k] * load_row(edges + 8ll * f + 4);
        }
        memcpy(out + 3ll * v, &total, 3 * sizeof(float));
    }
"""


def _with_constants(body: str) -> str:
    return body.replace("@FLAT@", "1e-6f").replace("@DAMPING@", "0.5e-6f")


_MODULE = "face_rotation_vectors"
faces = kernel(_MODULE, "faces", _with_constants(GEOMETRY + FACES))
vertices = kernel(_MODULE, "vertices", VERTICES)
vertices_backward = kernel(_MODULE, "vertices_backward", VERTICES_BACKWARD)
faces_backward = kernel(_MODULE, "faces_backward", _with_constants(GEOMETRY + FACES_BACKWARD))
gather_edges = kernel(_MODULE, "gather_edges", GATHER_EDGES)
