const int vertex_blocks = (n_on_vertices + BLOCK - 1) / BLOCK;
const int blocks = vertex_blocks + (n_on_faces + BLOCK - 1) / BLOCK;
const int pose = block_index / blocks, mine = block_index - pose * blocks;
const bool on_vertex = mine < vertex_blocks;
const int i = (on_vertex ? mine : mine - vertex_blocks) * BLOCK + threadIdx.x;
if (i >= (on_vertex ? n_on_vertices : n_on_faces)) return;
const long long gaussian = on_vertex ? i : (long long)n_on_vertices + i;  // among those of a pose
const long long at = pose * ((long long)n_on_vertices + n_on_faces) + gaussian;
const long long first_vertex = (long long)pose * n_vertices;
auto product = [](V4 a, V4 b) -> V4 {
    return {
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w
    };
};
auto conjugate = [](V4 a) -> V4 { return {a.w, -a.x, -a.y, -a.z}; };
auto growth = [&](float ratio) -> float {  // ratio^(half_powers / 2), the ratio bounded
    const float low = ratio > LIMIT ? LIMIT : ratio, r = low < 1.f / LIMIT ? 1.f / LIMIT : low;
    return half_powers == 0 ? 1.f : half_powers == 1 ? sqrtf(r) : r;
};
auto growth_slope = [&](float ratio) -> float {
    const bool inside = ratio >= 1.f / LIMIT && ratio <= LIMIT;
    return inside ? 0.5f * (float)half_powers * growth(ratio) / ratio : 0.f;
};
// The unit rotation of the Gaussian's place on the mesh.
struct OnVertex {
    V4 turn;
    float per_length;
};
auto at_vertex = [&](long long v) -> OnVertex {
    const V4 q = get4(vertex_quats, v);
    const float length = sqrtf(dot4(q, q)), per_length = length > 0.f ? 1.f / length : 0.f;
    return {scaled4(per_length, q), per_length};
};
struct OnFace {
    V4 turn, q[3];
    float sign[3], per_length;
};
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
