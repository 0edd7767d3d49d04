// The vertices of 16 Gaussians from i, and their rotations.

const int* v = indices_of(vertex_index + i, count);
V4 q = rows([&](int lane) -> Q { return load_row(vertex_quats + 4ll * v[lane]); });
const V length = root(dot4(q, q));
const V per_length = length > 0.f ? 1.f / length : zero;
q = scaled4(per_length, q);
const V3 u = {q.x, q.y, q.z}, o = get3(offsets + 3ll * i, count), t = scaled((V)(2.f), cross(u, o));
const V grown = growth(pick(vertex_area_ratio, v), half_powers);
