#include "on_mesh.h"
int last_indices[16];
auto indices_of = [&](const int* from, int count) -> const int* {
    if (count == 16) return from;
    memset(last_indices, 0, sizeof last_indices);
    memcpy(last_indices, from, count * sizeof(int));
    return last_indices;
};
const I lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
int gathered[48];
auto corners_of = [&](const int* f) -> const int* {  // often the faces follow one another, as their corners do then
    if (__builtin_reduce_and(*(const IU*)f == f[0] + lanes)) return faces + 3ll * f[0];
    for (int lane = 0; lane < 16; lane++) memcpy(gathered + 3 * lane, faces + 3ll * f[lane], 3 * sizeof(int));
    return gathered;
};
auto pick = [&](const float* from, const int* index) -> V {
    V v;
    for (int lane = 0; lane < 16; lane++) v[lane] = from[index[lane]];
    return v;
};
auto get3_or_zero = [&](const float* p, long long i, int count) -> V3 {
    return p ? get3(p + 3 * i, count) : (V3){zero, zero, zero};
};
auto get4_or_zero = [&](const float* p, long long i, int count) -> V4 {
    return p ? get4(p + 4 * i, count) : (V4){zero, zero, zero, zero};
};
