struct V3 {
    float x, y, z;
};
struct __align__(16) V4 {
    float w, x, y, z;
};
auto dot3 = [](V3 a, V3 b) -> float { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto dot4 = [](V4 a, V4 b) -> float { return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](V3 a, V3 b) -> V3 { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; };
auto scaled = [](float s, V3 a) -> V3 { return {s * a.x, s * a.y, s * a.z}; };
auto scaled4 = [](float s, V4 a) -> V4 { return {s * a.w, s * a.x, s * a.y, s * a.z}; };
auto plus = [](V3 a, V3 b) -> V3 { return {a.x + b.x, a.y + b.y, a.z + b.z}; };
auto minus = [](V3 a, V3 b) -> V3 { return {a.x - b.x, a.y - b.y, a.z - b.z}; };
auto plus4 = [](V4 a, V4 b) -> V4 { return {a.w + b.w, a.x + b.x, a.y + b.y, a.z + b.z}; };
auto get3 = [](const float* p, long long i) -> V3 {
    p += 3 * i;
    return {p[0], p[1], p[2]};
};
auto put3 = [](float* p, long long i, V3 v) {
    p += 3 * i;
    p[0] = v.x;
    p[1] = v.y;
    p[2] = v.z;
};
auto get4 = [](const float* p, long long i) -> V4 { return ((const V4*)p)[i]; };
auto put4 = [](float* p, long long i, V4 v) { ((V4*)p)[i] = v; };
const V4 identity = {1.f, 0.f, 0.f, 0.f};
