"""Float32 posing of Gaussians on CUDA: what `barycentric` computes.

`pose_riders` (one thread a Gaussian; blocks for those on vertices, then blocks for those on faces). Backward:
`pose_riders_backward` (likewise) writes each Gaussian's row of eight for the vertices it rides on, (by position, by
area ratio, by rotation), and for each of its corners the weight of the second half; that of the first are its
barycentrics. Then `gather_riders` (blocks for vertices, then blocks for faces; one thread each) adds up the rows at
vertices, and the gradients of area ratios at faces.
"""

from oasis_kernels.posing.cuda_posing import BLOCK, HEAD, expanded
from oasis_kernels.runtime.cuda_native import cuda_native

PLACE = """
    const int vertex_blocks = (n_on_vertices + @BLOCK@ - 1) / @BLOCK@;
    const int blocks = vertex_blocks + (n_on_faces + @BLOCK@ - 1) / @BLOCK@;
    const int pose = block_index / blocks, mine = block_index - pose * blocks;
    const bool on_vertex = mine < vertex_blocks;
    const int i = (on_vertex ? mine : mine - vertex_blocks) * @BLOCK@ + threadIdx.x;
    if (i >= (on_vertex ? n_on_vertices : n_on_faces)) return;
    const long long rider = on_vertex ? i : (long long)n_on_vertices + i;  // among those of a pose
    const long long at = pose * ((long long)n_on_vertices + n_on_faces) + rider;
    const long long first_vertex = (long long)pose * n_vertices;
    auto product = [](V4 a, V4 b) -> V4 {
        return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
                a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
    };
    auto conjugate = [](V4 a) -> V4 { return {a.w, -a.x, -a.y, -a.z}; };
    auto growth = [&](float ratio) -> float {  // ratio^(half_powers / 2), the ratio bounded
        const float low = ratio > @LIMIT@ ? @LIMIT@ : ratio, r = low < 1.f / @LIMIT@ ? 1.f / @LIMIT@ : low;
        return half_powers == 0 ? 1.f : half_powers == 1 ? sqrtf(r) : r;
    };
    auto growth_slope = [&](float ratio) -> float {
        const bool inside = ratio >= 1.f / @LIMIT@ && ratio <= @LIMIT@;
        return inside ? 0.5f * (float)half_powers * growth(ratio) / ratio : 0.f;
    };
    // The unit rotation of the Gaussian's place on the mesh.
    struct OnVertex { V4 turn; float per_length; };
    auto at_vertex = [&](long long v) -> OnVertex {
        const V4 q = get4(vertex_quats, v);
        const float length = sqrtf(dot4(q, q)), per_length = length > 0.f ? 1.f / length : 0.f;
        return {scaled4(per_length, q), per_length};
    };
    struct OnFace { V4 turn, q[3]; float sign[3], per_length; };
    auto on_face = [&](V3 b, const long long* v) -> OnFace {
        OnFace o;
        for (int k = 0; k < 3; k++) o.q[k] = get4(vertex_quats, v[k]);
        const bool second = b.y > b.x && b.y >= b.z, third = !second && b.z > b.x;
        const V4 reference = second ? o.q[1] : third ? o.q[2] : o.q[0];
        for (int k = 0; k < 3; k++) o.sign[k] = dot4(o.q[k], reference) < 0.f ? -1.f : 1.f;
        const V4 rest = plus4(scaled4(b.y * o.sign[1], o.q[1]), scaled4(b.z * o.sign[2], o.q[2]));
        const V4 sum = plus4(scaled4(b.x * o.sign[0], o.q[0]), rest);
        const float length = sqrtf(dot4(sum, sum));
        o.per_length = length > 0.f ? 1.f / length : 0.f;
        o.turn = length > 0.f ? scaled4(o.per_length, sum) : reference;
        return o;
    };
"""

POSE = PLACE + """
    V3 mean;
    V4 turn;
    float ratio;
    if (on_vertex) {
        const long long v = first_vertex + vertex_index[i];
        turn = at_vertex(v).turn;
        const V3 u = {turn.x, turn.y, turn.z}, o = get3(offsets, i), t = scaled(2.f, cross(u, o));
        mean = plus(get3(vertices, v), plus(o, plus(scaled(turn.w, t), cross(u, t))));
        ratio = vertex_area_ratio[v];
    } else {
        const long long f = face_index[i];
        const long long v[3] = {first_vertex + faces[3 * f], first_vertex + faces[3 * f + 1],
                                first_vertex + faces[3 * f + 2]};
        const V3 b = get3(barycentrics, i);
        turn = on_face(b, v).turn;
        mean = plus(plus(scaled(b.x, get3(vertices, v[0])), scaled(b.y, get3(vertices, v[1]))),
                    scaled(b.z, get3(vertices, v[2])));
        ratio = area_ratio[(long long)pose * n_faces + f];
    }
    put3(means, at, mean);
    put4(posed_quats, at, product(turn, get4(quats, rider)));
    put3(posed_scales, at, scaled(growth(ratio), get3(scales, rider)));
"""

POSE_BACKWARD = PLACE + """
    const V3 none = {0.f, 0.f, 0.f};
    const V3 g_mean = g_means ? get3(g_means, at) : none, g_scale = g_posed_scales ? get3(g_posed_scales, at) : none;
    V4 g_quat = {0.f, 0.f, 0.f, 0.f};
    if (g_posed_quats) g_quat = get4(g_posed_quats, at);
    if (on_vertex) {
        const long long v = first_vertex + vertex_index[i];
        const OnVertex place = at_vertex(v);
        const V4 q = place.turn;
        const V3 u = {q.x, q.y, q.z}, o = get3(offsets, i), t = scaled(2.f, cross(u, o));
        const float ratio = vertex_area_ratio[v];
        if (g_offsets) {
            const V3 back = scaled(2.f, cross(u, g_mean));
            put3(g_offsets, (long long)pose * n_on_vertices + i,
                 plus(g_mean, minus(cross(u, back), scaled(q.w, back))));
        }
        if (g_quats) put4(g_quats, at, product(conjugate(q), g_quat));
        if (g_scales) put3(g_scales, at, scaled(growth(ratio), g_scale));
        if (rows_of_riders) {
            // Of u -> o + w t + u x t, which is the rotation for unit quaternions; then only what turns is kept.
            const V3 by_u = plus(scaled(2.f * q.w, cross(o, g_mean)),
                                 minus(plus(scaled(2.f * dot3(g_mean, u), o), scaled(2.f * dot3(u, o), g_mean)),
                                       scaled(4.f * dot3(g_mean, o), u)));
            V4 g = plus4(product(g_quat, conjugate(get4(quats, rider))), {dot3(g_mean, t), by_u.x, by_u.y, by_u.z});
            g = scaled4(place.per_length, plus4(g, scaled4(-dot4(g, q), q)));
            const float by_area = growth_slope(ratio) * dot3(g_scale, get3(scales, rider));
            put4(rows_of_riders, 2 * at, {g_mean.x, g_mean.y, g_mean.z, by_area});
            put4(rows_of_riders, 2 * at + 1, g);
        }
        return;
    }
    const long long f = face_index[i], here = (long long)pose * n_on_faces + i;
    const long long v[3] = {first_vertex + faces[3 * f], first_vertex + faces[3 * f + 1],
                            first_vertex + faces[3 * f + 2]};
    const V3 b = get3(barycentrics, i);
    const OnFace place = on_face(b, v);
    const float ratio = area_ratio[(long long)pose * n_faces + f];
    if (g_quats) put4(g_quats, at, product(conjugate(place.turn), g_quat));
    if (g_scales) put3(g_scales, at, scaled(growth(ratio), g_scale));
    if (by_ratio) by_ratio[here] = growth_slope(ratio) * dot3(g_scale, get3(scales, rider));
    V4 g = product(g_quat, conjugate(get4(quats, rider)));
    g = scaled4(place.per_length, plus4(g, scaled4(-dot4(g, place.turn), place.turn)));
    if (rows_of_riders) {
        put4(rows_of_riders, 2 * at, {g_mean.x, g_mean.y, g_mean.z, 0.f});
        put4(rows_of_riders, 2 * at + 1, g);
        put3(weights, here, {b.x * place.sign[0], b.y * place.sign[1], b.z * place.sign[2]});
    }
    if (g_barycentrics) {
        float by[3];
        for (int k = 0; k < 3; k++) by[k] = dot3(g_mean, get3(vertices, v[k])) + place.sign[k] * dot4(g, place.q[k]);
        put3(g_barycentrics, here, {by[0], by[1], by[2]});
    }
"""

# A vertex's places: 0 .. P - 1 are Gaussians on it, P + 3 i + k is the corner k of Gaussian P + i.
GATHER = """
    const int vertex_blocks = @VERTEX_BLOCKS@, blocks = vertex_blocks + @FACE_BLOCKS@;
    const int pose = block_index / blocks, mine = block_index - pose * blocks;
    const long long first_on_face = (long long)pose * n_on_faces;
    if (mine >= vertex_blocks) {
        const int f = (mine - vertex_blocks) * @BLOCK@ + threadIdx.x;
        if (f >= n_faces) return;
        float total = 0.f;
        for (int j = face_starts[f]; j < face_starts[f + 1]; j++) total += by_ratio[first_on_face + riders[j]];
        g_area_ratio[(long long)pose * n_faces + f] = total;
        return;
    }
    const int v = mine * @BLOCK@ + threadIdx.x;
    if (v >= n_vertices) return;
    const float* rows = rows_of_riders + pose * ((long long)n_on_vertices + n_on_faces) * 8;
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
"""

COUNTS = {
    "n_vertices": "int",
    "n_faces": "int",
    "n_on_vertices": "int",  # P
    "n_on_faces": "int",  # Q
}
INPUTS = COUNTS | {
    "half_powers": "int",
    "vertices": "const float*",  # [B, V, 3]
    "faces": "const int*",  # [F, 3]
    "vertex_index": "const int*",  # [P]
    "face_index": "const int*",  # [Q]
    "barycentrics": "const float*",  # [Q, 3]
    "vertex_quats": "const float*",  # [B, V, 4]
    "area_ratio": "const float*",  # [B, F]
    "vertex_area_ratio": "const float*",  # [B, V]
    "offsets": "const float*",  # [P, 3]
    "quats": "const float*",  # [P + Q, 4]
    "scales": "const float*",  # [P + Q, 3]
}


def _expanded(body: str) -> str:
    return expanded(
        HEAD + body,
        VERTEX_BLOCKS="(rows_of_riders ? (n_vertices + @BLOCK@ - 1) / @BLOCK@ : 0)",
        FACE_BLOCKS="(g_area_ratio ? (n_faces + @BLOCK@ - 1) / @BLOCK@ : 0)",
        BLOCK=BLOCK,
        LIMIT="1e4f",
    )


pose_riders = cuda_native(
    "pose_riders",
    INPUTS
    | {
        "means": "float*",  # [B, P + Q, 3]
        "posed_quats": "float*",  # [B, P + Q, 4]
        "posed_scales": "float*",  # [B, P + Q, 3]
    },
    _expanded(POSE),
    BLOCK,
)
"""Kernel: for each pose, one block for every `BLOCK` Gaussians on vertices, then one for every `BLOCK` on faces."""

pose_riders_backward = cuda_native(
    "pose_riders_backward",
    INPUTS
    | {
        "g_means": "const float*",  # these three may be 0
        "g_posed_quats": "const float*",
        "g_posed_scales": "const float*",
        "rows_of_riders": "float*",  # [B, P + Q, 8]; 0 if nothing of vertices is wanted
        "weights": "float*",  # [B, Q, 3], with the rows
        "by_ratio": "float*",  # [B, Q]; 0 if area ratios are not wanted
        "g_barycentrics": "float*",  # [B, Q, 3]; each of these is 0 if not wanted
        "g_quats": "float*",  # [B, P + Q, 4]
        "g_scales": "float*",  # [B, P + Q, 3]
        "g_offsets": "float*",  # [B, P, 3]
    },
    _expanded(POSE_BACKWARD),
    BLOCK,
)
"""Kernel: blocks as for `pose_riders`."""

gather_riders = cuda_native(
    "gather_riders",
    COUNTS
    | {
        "barycentrics": "const float*",  # [Q, 3]
        "rows_of_riders": "const float*",
        "weights": "const float*",
        "by_ratio": "const float*",
        "vertex_starts": "const int*",  # [V + 1]; of `places`, for each vertex
        "places": "const int*",  # [P + 3 Q]; i < P: the Gaussian i on a vertex; P + 3 i + k: corner k of Gaussian P + i
        "face_starts": "const int*",  # [F + 1]; of `riders`, for each face
        "riders": "const int*",  # [Q]
        "g_vertices": "float*",  # [B, V, 3]; each of these is 0 if not wanted
        "g_vertex_quats": "float*",  # [B, V, 4]
        "g_vertex_area_ratio": "float*",  # [B, V]
        "g_area_ratio": "float*",  # [B, F]
    },
    _expanded(GATHER),
    BLOCK,
)
"""Kernel: for each pose, one block for every `BLOCK` vertices if there are rows, then one for every `BLOCK` faces if
area ratios are wanted."""
