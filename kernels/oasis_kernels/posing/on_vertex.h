// The vertices of 16 Gaussians from i, and their rotations.

const int* v = indices_of(vertex_index + i, count);
const OnVertex place = at_vertex(rows([&](int lane) -> Q { return load_row(vertex_quats + 4ll * v[lane]); }));
const V4 q = place.q;
const V3 u = {q.x, q.y, q.z}, o = get3(offsets + 3ll * i, count), t = scaled((V)(2.f), cross(u, o));
const V grown = growth(pick(vertex_area_ratio, v));
