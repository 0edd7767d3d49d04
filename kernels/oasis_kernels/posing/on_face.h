// The faces of 16 Gaussians from i, and the rotations of their places.

const long long at = n_on_vertices + (long long)i;
const int* f = indices_of(face_index + i, count);
const int* c = corners_of(f);
const V3 b = get3(barycentrics + 3ll * i, count);
V4 q[3];
for (int k = 0; k < 3; k++) q[k] = rows([&](int lane) -> Q { return load_row(vertex_quats + 4ll * c[3 * lane + k]); });
const I second = (b.y > b.x) & (b.y >= b.z), third = ~second & (b.z > b.x);
const V4 reference = choose4(second, q[1], choose4(third, q[2], q[0]));
auto aligned = [&](V4 a) -> V { return dot4(a, reference) < 0.f ? -one : one; };
const V3 sign = {aligned(q[0]), aligned(q[1]), aligned(q[2])};
const V4 rest = plus4(scaled4(b.y * sign.y, q[1]), scaled4(b.z* sign.z, q[2]));
const V4 sum = plus4(scaled4(b.x * sign.x, q[0]), rest);
const V length = root(dot4(sum, sum));
const I mixed = length > 0.f;
const V per_length = mixed ? 1.f / length : zero;
const V4 turn = choose4(mixed, scaled4(per_length, sum), reference);
const V ratio = pick(area_ratio, f), grown = growth(ratio, half_powers);
