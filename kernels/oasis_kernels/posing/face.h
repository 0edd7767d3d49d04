// Triangles, seen from the corner where the longest edge at rest begins: one text for the CPU and CUDA.
struct Triangle {
    V3 t, b, n;
    V l, x, y, longest, scale, unit;
    I flat, point;
};
struct Edges {
    V3 a, b, c;
    V scale, unit;
};
auto edges_of = [&](V3 p0, V3 p1, V3 p2) -> Edges {
    Edges e = {minus(p1, p0), minus(p2, p1), minus(p0, p2)};
    auto size = [&](V3 s) -> V { return largest(magnitude(s.x), largest(magnitude(s.y), magnitude(s.z))); };
    const V most = largest((V)(1e-30f), largest(size(e.a), largest(size(e.b), size(e.c))));
    e.unit = power_below(most);
    e.scale = inverse_power(e.unit);
    e.a = scaled(e.scale, e.a);
    e.b = scaled(e.scale, e.b);
    e.c = scaled(e.scale, e.c);
    return e;
};
struct Start {
    I a, b;
};  // whether the longest edge is a, b, else c
auto start = [&](const Edges& e) -> Start {
    const V la = dot3(e.a, e.a), lb = dot3(e.b, e.b), lc = dot3(e.c, e.c);
    const I a = (la >= lb) & (la >= lc);
    return {a, !a & (lb >= lc)};
};
auto completed = [&](Triangle o) -> Triangle {
    o.point = !(o.longest > 0.f);
    o.n = cross(o.t, o.b);
    o.flat = !(o.l * o.y > FLAT * o.longest);
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
// A row of the table of triangles at rest, in three parts, and back.
struct Row {
    V4 p, q, r;
};
auto to_row = [&](const Triangle& o, const Start& from) -> Row {
    const V begins = from.a ? zero : from.b ? one : (V)(2.f);
    return {{o.t.x, o.t.y, o.t.z, o.l}, {o.b.x, o.b.y, o.b.z, o.x}, {o.y, o.longest, o.unit, begins}};
};
auto from_row = [&](V4 p, V4 q, V4 r, Start& from) -> Triangle {
    Triangle o;
    o.t = {p.w, p.x, p.y};
    o.l = p.z;
    o.b = {q.w, q.x, q.y};
    o.x = q.z;
    o.y = r.w;
    o.longest = r.x;
    o.unit = r.y;
    o.scale = inverse_power(o.unit);
    from = {r.z == 0.f, r.z == 1.f};
    return completed(o);
};
struct Pair {
    Triangle rest, posed;
    Start from;
    I proper;
    V weight, damped, ratio, c, s, h;
    V3 t, b;
};
auto pair_of = [&](const Triangle& rest, const Triangle& posed, const Start& from) -> Pair {
    Pair o;
    o.rest = rest;
    o.posed = posed;
    o.from = from;
    o.weight = 0.5f * rest.l * rest.y * rest.unit * rest.unit;
    o.proper = !rest.flat & !posed.flat & (o.weight > 0.f);
    o.weight = o.proper ? o.weight : zero;
    const V damping = DAMPING * rest.longest;
    const V larger = rest.scale * posed.unit;  // of the posed scale; bounded, for its square to be finite
    const V growth = larger < 0x1p60f ? larger : (V)(0x1p60f);
    o.damped = 0.5f * rest.l * rest.y + damping;
    const V grown = 0.5f * posed.l * posed.y * growth * growth + damping;
    o.ratio = rest.point ? one : grown / o.damped;
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
// The rotation as a quaternion, the identity for faces that are not proper; the largest component is found first
// (Shepperd 1978).
auto quaternion_of = [&](const Pair& p) -> V4 {
    const V3 t = p.rest.t, b = p.rest.b, n = p.rest.n, n1 = p.posed.n;
    auto entry = [&](V u, V v, V w, V x, V y, V z) -> V { return u * x + v * y + w * z; };
    const V m00 = entry(p.t.x, p.b.x, n1.x, t.x, b.x, n.x), m01 = entry(p.t.x, p.b.x, n1.x, t.y, b.y, n.y);
    const V m02 = entry(p.t.x, p.b.x, n1.x, t.z, b.z, n.z), m10 = entry(p.t.y, p.b.y, n1.y, t.x, b.x, n.x);
    const V m11 = entry(p.t.y, p.b.y, n1.y, t.y, b.y, n.y), m12 = entry(p.t.y, p.b.y, n1.y, t.z, b.z, n.z);
    const V m20 = entry(p.t.z, p.b.z, n1.z, t.x, b.x, n.x), m21 = entry(p.t.z, p.b.z, n1.z, t.y, b.y, n.y);
    const V m22 = entry(p.t.z, p.b.z, n1.z, t.z, b.z, n.z);
    const V trace = m00 + m11 + m22;
    const I w = (trace >= m00) & (trace >= m11) & (trace >= m22), x = !w & (m00 >= m11) & (m00 >= m22);
    const I y = !w & !x & (m11 >= m22);
    const V wx = m21 - m12, wy = m02 - m20, wz = m10 - m01, xy = m01 + m10, xz = m02 + m20, yz = m12 + m21;
    const V4 q = {
        w   ? 1.f + trace
        : x ? wx
        : y ? wy
            : wz,
        w   ? wx
        : x ? 1.f + m00 - m11 - m22
        : y ? xy
            : xz,
        w   ? wy
        : x ? xy
        : y ? 1.f - m00 + m11 - m22
            : yz,
        w   ? wz
        : x ? xz
        : y ? yz
            : 1.f - m00 - m11 + m22
    };
    const V length = 1.f / root(dot4(q, q));
    return choose4(p.proper, scaled4(q.w < 0.f ? -length : length, q), {one, zero, zero, zero});
};
