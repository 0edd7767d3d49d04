// Gaussians on a mesh: one text for the CPU and CUDA.
auto product = [](V4 a, V4 b) -> V4 {
    return {
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w
    };
};
auto conjugate = [](V4 a) -> V4 { return {a.w, -a.x, -a.y, -a.z}; };
auto growth = [&](V ratio) -> V {  // ratio^(half_powers / 2), the ratio bounded
    const V low = ratio > LIMIT ? (V)(LIMIT) : ratio;
    const V r = low < 1.f / LIMIT ? (V)(1.f / LIMIT) : low;
    return half_powers == 0 ? one : half_powers == 1 ? root(r) : r;
};
auto growth_slope = [&](V ratio) -> V {
    const V slope = 0.5f * (float)half_powers * growth(ratio) / ratio;
    const I inside = (ratio >= 1.f / LIMIT) & (ratio <= LIMIT);
    return inside ? slope : zero;
};
// The unit rotation of a Gaussian's place on the mesh.
struct OnVertex {
    V4 q;
    V per_length;
};
auto at_vertex = [&](V4 q) -> OnVertex {
    const V length = root(dot4(q, q));
    const V per_length = length > 0.f ? 1.f / length : zero;
    return {scaled4(per_length, q), per_length};
};
struct OnFace {
    V4 rotation;
    V3 sign;
    V per_length;
};
auto at_face = [&](V3 b, const V4* q) -> OnFace {
    const I second = (b.y > b.x) & (b.y >= b.z), third = !second & (b.z > b.x);
    const V4 reference = choose4(second, q[1], choose4(third, q[2], q[0]));
    auto aligned = [&](V4 a) -> V { return dot4(a, reference) < 0.f ? -one : one; };
    const V3 sign = {aligned(q[0]), aligned(q[1]), aligned(q[2])};
    const V4 rest = plus4(scaled4(b.y * sign.y, q[1]), scaled4(b.z * sign.z, q[2]));
    const V4 sum = plus4(scaled4(b.x * sign.x, q[0]), rest);
    const V length = root(dot4(sum, sum));
    const I mixed = length > 0.f;
    const V per_length = mixed ? 1.f / length : zero;
    return {choose4(mixed, scaled4(per_length, sum), reference), sign, per_length};
};
// By the quaternion before it was normalised, given the gradient by the unit one: only what rotates is kept.
auto unnormalised = [&](V4 g, V4 q, V per_length) -> V4 {
    return scaled4(per_length, plus4(g, scaled4(-dot4(g, q), q)));
};
// By u and w of o + w t + u x t, the rotated offset: for unit quaternions that is all of it.
auto by_rotation = [&](V3 g_mean, V4 q, V3 u, V3 o, V3 t) -> V4 {
    const V3 by_u = plus(
        scaled(2.f * q.w, cross(o, g_mean)),
        minus(
            plus(scaled(2.f * dot3(g_mean, u), o), scaled(2.f * dot3(u, o), g_mean)), scaled(4.f * dot3(g_mean, o), u)
        )
    );
    return {dot3(g_mean, t), by_u.x, by_u.y, by_u.z};
};
