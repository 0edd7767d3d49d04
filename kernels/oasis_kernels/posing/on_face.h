// The faces of 16 Gaussians from i, and the rotations of their places.

const long long at = n_on_vertices + (long long)i;
const int* f = indices_of(face_index + i, count);
const int* c = corners_of(f);
const V3 b = get3(barycentrics + 3ll * i, count);
V4 q[3];
for (int k = 0; k < 3; k++) q[k] = rows([&](int lane) -> Q { return load_row(vertex_quats + 4ll * c[3 * lane + k]); });
const OnFace place = at_face(b, q);
const V ratio = pick(area_ratio, f), grown = growth(ratio);
