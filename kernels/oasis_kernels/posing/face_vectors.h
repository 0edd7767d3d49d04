struct Triangle {
    V3 t, b, n;
    V l, x, y, longest, scale, unit;
    I flat, point;
};
const I mantissa_off = (I)(0x7f800000), inverse = (I)(0x7f000000);
struct Edges {
    V3 a, b, c;
    V scale, unit;
};
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
struct Start {
    I a, b;
};  // whether the longest edge is a, b, else c
auto start = [&](const Edges& e) -> Start {
    const V la = dot3(e.a, e.a), lb = dot3(e.b, e.b), lc = dot3(e.c, e.c);
    const I a = (la >= lb) & (la >= lc);
    return {a, ~a & (lb >= lc)};
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
auto at_rest = [&](const Table& vertices, int first, int count, const int* corners, Start& from) -> Triangle {
    if (!triangles) {
        const Edges e = edges(vertices, corners);
        from = start(e);
        return triangle(e, from);
    }
    auto part = [&](int k) -> V4 {
        return rows([&](int lane) -> Q {
            return load_row(triangles + 12ll * (first + wp::min(lane, count - 1)) + 4 * k);
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
struct Pair {
    Triangle rest, posed;
    Start from;
    I proper;
    V weight, damped, ratio, c, s, h;
    V3 t, b;
};
auto pair = [&](const Table& before, const Table& after, int first, int count, const int* corners) -> Pair {
    Pair o;
    const Triangle rest = at_rest(before, first, count, corners, o.from);
    const Triangle posed = triangle(edges(after, corners), o.from);
    o.rest = rest;
    o.posed = posed;
    o.weight = 0.5f * rest.l * rest.y * rest.unit * rest.unit;
    o.proper = ~rest.flat & ~posed.flat & (o.weight > 0.f);
    o.weight = o.proper ? o.weight : zero;
    const V damping = DAMPING * rest.longest;
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
