// Gradients by the edges of a pair of triangles, as seen from corner 0, given those by the rotation, `omega`, by the
// areas and by the ratio of the areas: one text for the CPU and CUDA.
const V per_trace = p.proper ? 1.f / p.h : zero;
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
    PUT_EDGE(to, 0, {by_e1.x, by_e1.y, by_e1.z, zero});
    PUT_EDGE(to, 1, {by_e2.x, by_e2.y, by_e2.z, zero});
};
V3 g1, g2;
if (posed_edges) {
    const V3 o1 = scaled(r.l, p.t), o2 = plus(scaled(r.x, p.t), scaled(r.y, p.b));
    edge_gradients(o, omega, o1, o2, by_posed, zero, g1, g2);
    store_edges(posed_edges + 8 * at, g1, g2);
}
if (rest_edges) {
    const V3 back = {-dot3(omega, p.t), -dot3(omega, p.b), -dot3(omega, o.n)};
    const V3 w = plus(scaled(back.x, r.t), plus(scaled(back.y, r.b), scaled(back.z, r.n)));
    const V3 t = minus(scaled(p.c, r.t), scaled(p.s, r.b));  // posed t and b, rotated back
    const V3 b = plus(scaled(p.s, r.t), scaled(p.c, r.b));
    const V3 o1 = scaled(o.l, t), o2 = plus(scaled(o.x, t), scaled(o.y, b));
    edge_gradients(r, w, o1, o2, by_rest, DAMPING * by_damping, g1, g2);
    store_edges(rest_edges + 8 * at, g1, g2);
}
