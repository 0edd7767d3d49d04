struct Edges {
    V3 a, b, c;
    float scale, unit;
};
auto edges = [&](const float* vertices, const int* corner) -> Edges {
    const V3 p0 = get3(vertices, corner[0]), p1 = get3(vertices, corner[1]), p2 = get3(vertices, corner[2]);
    Edges e = {minus(p1, p0), minus(p2, p1), minus(p0, p2)};
    auto size = [](V3 s) -> float { return fmaxf(fabsf(s.x), fmaxf(fabsf(s.y), fabsf(s.z))); };
    const float most = fmaxf(1e-30f, fmaxf(size(e.a), fmaxf(size(e.b), size(e.c))));
    const int power = __float_as_int(most) & 0x7f800000;
    e.unit = __int_as_float(power);
    e.scale = __int_as_float(0x7f000000 - power);
    e.a = scaled(e.scale, e.a);
    e.b = scaled(e.scale, e.b);
    e.c = scaled(e.scale, e.c);
    return e;
};
auto start = [&](const Edges& e) -> int {  // the corner where the longest edge begins
    const float la = dot3(e.a, e.a), lb = dot3(e.b, e.b), lc = dot3(e.c, e.c);
    return la >= lb && la >= lc ? 0 : lb >= lc ? 1 : 2;
};
struct Triangle {
    V3 t, b, n;
    float l, x, y, longest, scale, unit;
    bool flat;
};
auto completed = [&](Triangle o) -> Triangle {
    o.n = cross(o.t, o.b);
    o.flat = !(o.l * o.y > FLAT * o.longest);
    return o;
};
auto triangle = [&](const Edges& e, int from) -> Triangle {
    Triangle o;
    const V3 e1 = from == 0 ? e.a : from == 1 ? e.b : e.c;
    const V3 e3 = from == 0 ? e.c : from == 1 ? e.a : e.b;  // comes back to the corner
    const V3 e2 = scaled(-1.f, e3);
    o.longest = fmaxf(dot3(e.a, e.a), fmaxf(dot3(e.b, e.b), dot3(e.c, e.c)));
    o.l = sqrtf(dot3(e1, e1));
    o.t = scaled(o.l > 0.f ? 1.f / o.l : 0.f, e1);
    o.x = dot3(e2, o.t);
    const V3 height = minus(e2, scaled(o.x, o.t));
    o.y = sqrtf(dot3(height, height));
    o.b = scaled(o.y > 0.f ? 1.f / o.y : 0.f, height);
    o.scale = e.scale;
    o.unit = e.unit;
    return completed(o);
};
auto at_rest = [&](long long f, const int* corner, int& from) -> Triangle {
    if (!triangles) {
        const Edges e = edges(rest_vertices, corner);
        from = start(e);
        return triangle(e, from);
    }
    const V4 p = get4(triangles, 3 * f), q = get4(triangles, 3 * f + 1), r = get4(triangles, 3 * f + 2);
    Triangle o;
    o.t = {p.w, p.x, p.y};
    o.l = p.z;
    o.b = {q.w, q.x, q.y};
    o.x = q.z;
    o.y = r.w;
    o.longest = r.x;
    o.unit = r.y;
    o.scale = __int_as_float(0x7f000000 - __float_as_int(o.unit));
    from = (int)r.z;
    return completed(o);
};
struct Pair {
    Triangle rest, posed;
    int from;
    bool proper;
    float weight, damped, ratio, c, s, h;
    V3 t, b;
};
auto pair = [&](const float* posed_vertices, long long f, const int* corner) -> Pair {
    Pair o;
    o.rest = at_rest(f, corner, o.from);
    o.posed = triangle(edges(posed_vertices, corner), o.from);
    const Triangle &rest = o.rest, &posed = o.posed;
    o.weight = 0.5f * rest.l * rest.y * rest.unit * rest.unit;
    o.proper = !rest.flat && !posed.flat && o.weight > 0.f;
    o.weight = o.proper ? o.weight : 0.f;
    const float damping = DAMPING * rest.longest;
    const float larger = rest.scale * posed.unit;  // of the posed scale; bounded, for its square to be finite
    const float growth = larger < 0x1p60f ? larger : 0x1p60f;
    o.damped = 0.5f * rest.l * rest.y + damping;
    const float grown = 0.5f * posed.l * posed.y * growth * growth + damping;
    o.ratio = rest.longest > 0.f ? grown / o.damped : 1.f;
    o.c = posed.l * rest.y + rest.l * posed.y;
    o.s = posed.l * rest.x - rest.l * posed.x;
    o.h = sqrtf(o.c * o.c + o.s * o.s);
    const float per = o.proper ? 1.f / o.h : 0.f;
    o.c *= per;
    o.s *= per;
    o.t = plus(scaled(o.c, posed.t), scaled(o.s, posed.b));
    o.b = minus(scaled(o.c, posed.b), scaled(o.s, posed.t));
    return o;
};
