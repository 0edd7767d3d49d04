"""Float32 posing of Gaussians on the CPU: what `barycentric` computes, 16 Gaussians at once.

`on_vertices` and `on_faces` carry the Gaussians that ride on vertices and on faces. Backward they write, for each
Gaussian, one row of eight for the vertices it rides on, (by position, by area ratio, by rotation), and for each of its
corners the weights of the two halves; `gather_vertices` adds the rows up at vertices, `gather_faces` the gradients of
area ratios at faces.
"""

from oasis_kernels.posing_vectors import kernel

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
        return (ratio >= 1.f / @LIMIT@) & (ratio <= @LIMIT@) ? slope : zero;
    };
    int last_indices[48];
    auto indices_of = [&](const int* from, int count, int width) -> const int* {
        if (count == 16) return from;
        memset(last_indices, 0, sizeof last_indices);
        memcpy(last_indices, from, width * count * sizeof(int));
        return last_indices;
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

ON_VERTICES = """
    const Table vertices = table3(floats(0), (int)block[1]);
    const int* index = ints(2);
    const float *turns = floats(3), *ratios = floats(4), *offsets = floats(5), *quats = floats(6), *scales = floats(7);
    const int half_powers = (int)block[8];
    for (int i = first; i < end; i += 16) {
        const int count = wp::min(16, end - i);
        const int* v = indices_of(index + i, count, 1);
        const V4 place = rows([&](int lane) -> Q { return at3(vertices, v[lane]); });
        V4 q = rows([&](int lane) -> Q { return load_row(turns + 4ll * v[lane]); });
        const V length = root(dot4(q, q));
        const V per_length = length > 0.f ? 1.f / length : zero;
        q = scaled4(per_length, q);
        const V3 u = {q.x, q.y, q.z}, o = get3(offsets + 3ll * i, count), t = scaled((V)(2.f), cross(u, o));
        const V grown = growth(pick(ratios, v), half_powers);
"""

ON_VERTICES_FORWARD = """
        const V3 shift = plus(o, plus(scaled(q.w, t), cross(u, t)));
        put3(floats(9) + 3ll * i, count, plus({place.w, place.x, place.y}, shift));
        put4(floats(10) + 4ll * i, count, product(q, get4(quats + 4ll * i, count)));
        put3(floats(11) + 3ll * i, count, scaled(grown, get3(scales + 3ll * i, count)));
    }
"""

ON_VERTICES_BACKWARD = """
        const V3 g_mean = get3_or_zero(floats(9), i, count), g_scale = get3_or_zero(floats(11), i, count);
        const V4 g_quat = get4_or_zero(floats(10), i, count);
        float *rows_out = floats(12), *g_offsets = floats(13), *g_quats = floats(14), *g_scales = floats(15);
        if (g_offsets) {
            const V3 back = scaled((V)(-2.f), cross(u, g_mean));
            put3(g_offsets + 3ll * i, count, plus(g_mean, plus(scaled(q.w, back), scaled((V)(-1.f), cross(u, back)))));
        }
        if (g_quats) put4(g_quats + 4ll * i, count, product(conjugate(q), g_quat));
        if (g_scales) put3(g_scales + 3ll * i, count, scaled(grown, g_scale));
        if (rows_out) {
            // Of u -> o + w t + u x t, which is the rotation for unit quaternions; then only what turns is kept.
            const V3 by_u = plus(scaled(2.f * q.w, cross(o, g_mean)),
                                 minus(plus(scaled(2.f * dot3(g_mean, u), o), scaled(2.f * dot3(u, o), g_mean)),
                                       scaled(4.f * dot3(g_mean, o), u)));
            V4 g = plus4(product(g_quat, conjugate(get4(quats + 4ll * i, count))),
                         {dot3(g_mean, t), by_u.x, by_u.y, by_u.z});
            g = scaled4(per_length, plus4(g, scaled4(-dot4(g, q), q)));
            const V by_ratio = growth_slope(pick(ratios, v), half_powers)
                             * dot3(g_scale, get3(scales + 3ll * i, count));
            put4(rows_out + 8ll * i, count, {g_mean.x, g_mean.y, g_mean.z, by_ratio}, 8);
            put4(rows_out + 8ll * i + 4, count, g, 8);
        }
    }
"""

ON_FACES = """
    const Table vertices = table3(floats(0), (int)block[1]);
    const int *faces = ints(2), *face_index = ints(3);
    const float *turns = floats(4), *ratios = floats(5), *barycentrics = floats(6);
    const float *quats = floats(7), *scales = floats(8);
    const int half_powers = (int)block[9];
    for (int i = first; i < end; i += 16) {
        const int count = wp::min(16, end - i);
        const int* f = indices_of(face_index + i, count, 1);
        const V3 b = get3(barycentrics + 3ll * i, count);
        V4 q[3];
        for (int k = 0; k < 3; k++)
            q[k] = rows([&](int lane) -> Q { return load_row(turns + 4ll * faces[3ll * f[lane] + k]); });
        const I second = (b.y > b.x) & (b.y >= b.z), third = ~second & (b.z > b.x);
        const V4 reference = choose4(second, q[1], choose4(third, q[2], q[0]));
        auto aligned = [&](V4 a) -> V { return dot4(a, reference) < 0.f ? -one : one; };
        const V3 sign = {aligned(q[0]), aligned(q[1]), aligned(q[2])};
        const V4 sum = plus4(scaled4(b.x * sign.x, q[0]), plus4(scaled4(b.y * sign.y, q[1]), scaled4(b.z * sign.z, q[2])));
        const V length = root(dot4(sum, sum));
        const I mixed = length > 0.f;
        const V per_length = mixed ? 1.f / length : zero;
        const V4 turn = choose4(mixed, scaled4(per_length, sum), reference);
        const V ratio = pick(ratios, f), grown = growth(ratio, half_powers);
"""

ON_FACES_FORWARD = """
        V3 mean = {zero, zero, zero};
        for (int k = 0; k < 3; k++) {
            const V4 p = rows([&](int lane) -> Q { return at3(vertices, faces[3ll * f[lane] + k]); });
            mean = plus(mean, scaled(k == 0 ? b.x : k == 1 ? b.y : b.z, {p.w, p.x, p.y}));
        }
        put3(floats(10) + 3ll * i, count, mean);
        put4(floats(11) + 4ll * i, count, product(turn, get4(quats + 4ll * i, count)));
        put3(floats(12) + 3ll * i, count, scaled(grown, get3(scales + 3ll * i, count)));
    }
"""

ON_FACES_BACKWARD = """
        const V3 g_mean = get3_or_zero(floats(10), i, count), g_scale = get3_or_zero(floats(12), i, count);
        const V4 g_quat = get4_or_zero(floats(11), i, count);
        float *rows_out = floats(13), *weights = floats(14), *g_ratios = floats(15), *g_barycentrics = floats(16);
        float *g_quats = floats(17), *g_scales = floats(18);
        if (g_quats) put4(g_quats + 4ll * i, count, product(conjugate(turn), g_quat));
        if (g_scales) put3(g_scales + 3ll * i, count, scaled(grown, g_scale));
        if (g_ratios) put(g_ratios + i, count, growth_slope(ratio, half_powers)
                                               * dot3(g_scale, get3(scales + 3ll * i, count)));
        if (rows_out || g_barycentrics) {
            V4 g = product(g_quat, conjugate(get4(quats + 4ll * i, count)));
            g = scaled4(per_length, plus4(g, scaled4(-dot4(g, turn), turn)));
            if (rows_out) {
                put4(rows_out + 8ll * i, count, {g_mean.x, g_mean.y, g_mean.z, zero}, 8);
                put4(rows_out + 8ll * i + 4, count, g, 8);
                put3(weights + 3ll * i, count, {b.x * sign.x, b.y * sign.y, b.z * sign.z});
            }
            if (g_barycentrics) {
                V by[3];
                for (int k = 0; k < 3; k++) {
                    const V4 p = rows([&](int lane) -> Q { return at3(vertices, faces[3ll * f[lane] + k]); });
                    by[k] = dot3(g_mean, {p.w, p.x, p.y}) + (k == 0 ? sign.x : k == 1 ? sign.y : sign.z) * dot4(g, q[k]);
                }
                put3(g_barycentrics + 3ll * i, count, {by[0], by[1], by[2]});
            }
        }
    }
"""

GATHER_VERTICES = """
    // A vertex's places: 0 .. n - 1 are Gaussians on it, n + 3 i + k is the corner k of Gaussian n + i.
    const int *offsets = ints(0), *places = ints(1);
    const unsigned n_on_vertices = (unsigned)block[2];
    const float *from = floats(3), *barycentrics = floats(4), *weights = floats(5);
    float *g_vertices = floats(6), *g_turns = floats(7), *g_ratios = floats(8);
    for (int v = first; v < end; v++) {
        Q low = (Q)(0.f), high = (Q)(0.f);  // by position and area ratio; by rotation
        for (int j = offsets[v]; j < offsets[v + 1]; j++) {
            const unsigned place = (unsigned)places[j];
            const bool corner = place >= n_on_vertices;
            const unsigned at = place - n_on_vertices;
            const float* row = from + 8ll * (corner ? n_on_vertices + at / 3u : place);
            low += (corner ? barycentrics[at] : 1.f) * load_row(row);
            high += (corner ? weights[at] : 1.f) * load_row(row + 4);
        }
        if (g_vertices) memcpy(g_vertices + 3ll * v, &low, 3 * sizeof(float));
        if (g_turns) store_row(g_turns + 4ll * v, high);
        if (g_ratios) g_ratios[v] = low.w;
    }
"""

GATHER_FACES = """
    const int *offsets = ints(0), *riders = ints(1);
    const float* from = floats(2);
    float* out = floats(3);
    for (int f = first; f < end; f++) {
        float total = 0.f;
        for (int j = offsets[f]; j < offsets[f + 1]; j++) total += from[riders[j]];
        out[f] = total;
    }
"""

_MODULE = "barycentric_vectors"
_COMMON = COMMON.replace("@LIMIT@", "1e4f")
on_vertices = kernel(_MODULE, "on_vertices", _COMMON + ON_VERTICES + ON_VERTICES_FORWARD)
on_vertices_backward = kernel(_MODULE, "on_vertices_backward", _COMMON + ON_VERTICES + ON_VERTICES_BACKWARD)
on_faces = kernel(_MODULE, "on_faces", _COMMON + ON_FACES + ON_FACES_FORWARD)
on_faces_backward = kernel(_MODULE, "on_faces_backward", _COMMON + ON_FACES + ON_FACES_BACKWARD)
gather_vertices = kernel(_MODULE, "gather_vertices", GATHER_VERTICES)
gather_faces = kernel(_MODULE, "gather_faces", GATHER_FACES)
