typedef float V;
typedef bool I;
struct V3 {
    float x, y, z;
};
struct __align__(16) V4 {
    float w, x, y, z;
};
const float zero = 0.f, one = 1.f;
auto root = [](float a) -> float { return sqrtf(a); };
auto largest = [](float a, float b) -> float { return fmaxf(a, b); };
auto smallest = [](float a, float b) -> float { return fminf(a, b); };
auto magnitude = [](float a) -> float { return fabsf(a); };
auto power_below = [](float a) -> float { return __int_as_float(__float_as_int(a) & 0x7f800000); };
auto inverse_power = [](float a) -> float { return __int_as_float(0x7f000000 - __float_as_int(a)); };
#include "algebra.h"
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
