typedef double V __attribute__((ext_vector_type(8)));
typedef float F __attribute__((ext_vector_type(8)));
typedef float F16 __attribute__((ext_vector_type(16)));
typedef int N __attribute__((ext_vector_type(8)));
typedef double VU __attribute__((ext_vector_type(8), aligned(4)));  // arrays have the alignment of their elements
typedef float FU __attribute__((ext_vector_type(8), aligned(4)));
typedef float FU16 __attribute__((ext_vector_type(16), aligned(4)));
typedef decltype(V{} < V{}) I;

// Transposition of eight rows of 2, 3 or 4 numbers into vectors and back.
auto wide = [](F a) -> V { return __builtin_convertvector(a, V); };
auto narrow = [](V a) -> F { return __builtin_convertvector(a, F); };
auto join = [](F a, F b) -> F16 {
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
};
auto load2 = [](const float* p, F& x, F& y) {
    const F16 a = *(const FU16*)p;
    x = __builtin_shufflevector(a, a, 0, 2, 4, 6, 8, 10, 12, 14);
    y = __builtin_shufflevector(a, a, 1, 3, 5, 7, 9, 11, 13, 15);
};
auto load3 = [&](const float* p, F& x, F& y, F& z) {
    const F16 a = *(const FU16*)p;
    const F last = *(const FU*)(p + 16);
    const F16 b = join(last, last);
    x = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 18, 21);
    y = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 16, 19, 22);
    z = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 17, 20, 23);
};
auto load4 = [](const float* p, F& x, F& y, F& z, F& w) {
    const F16 a = *(const FU16*)p, b = *(const FU16*)(p + 16);
    x = __builtin_shufflevector(a, b, 0, 4, 8, 12, 16, 20, 24, 28);
    y = __builtin_shufflevector(a, b, 1, 5, 9, 13, 17, 21, 25, 29);
    z = __builtin_shufflevector(a, b, 2, 6, 10, 14, 18, 22, 26, 30);
    w = __builtin_shufflevector(a, b, 3, 7, 11, 15, 19, 23, 27, 31);
};
auto store2 = [](float* p, F x, F y) {
    *(FU16*)p = __builtin_shufflevector(x, y, 0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
};
auto store3 = [&](float* p, F x, F y, F z) {
    const F16 xy = join(x, y), zz = join(z, z);
    *(FU16*)p = __builtin_shufflevector(xy, zz, 0, 8, 16, 1, 9, 17, 2, 10, 18, 3, 11, 19, 4, 12, 20, 5);
    *(FU*)(p + 16) = __builtin_shufflevector(xy, zz, 13, 21, 6, 14, 22, 7, 15, 23);
};
auto store4 = [&](float* p, F x, F y, F z, F w) {
    const F16 xy = join(x, y), zw = join(z, w);
    *(FU16*)p = __builtin_shufflevector(xy, zw, 0, 8, 16, 24, 1, 9, 17, 25, 2, 10, 18, 26, 3, 11, 19, 27);
    *(FU16*)(p + 16) = __builtin_shufflevector(xy, zw, 4, 12, 20, 28, 5, 13, 21, 29, 6, 14, 22, 30, 7, 15, 23, 31);
};

auto reciprocal = [](V a) -> V { return 1.0 / a; };
auto quotient = [](double a, double b) -> double { return a / b; };
#include "projection.h"
// Symmetric part of eight 3 x 3 matrices: xx, xy, xz, yy, yz, zz.
auto load_covariance = [](const float* p, V* s) {
    const int pair[6][2] = {{0, 0}, {1, 3}, {2, 6}, {4, 4}, {5, 7}, {8, 8}};
    for (int k = 0; k < 6; k++)
        for (int lane = 0; lane < 8; lane++)
            s[k][lane] = 0.5 * ((double)p[9 * lane + pair[k][0]] + (double)p[9 * lane + pair[k][1]]);
};

const long long n_chunks = (n + CHUNK - 1) / CHUNK;
Camera* cameras = (Camera*)malloc(n_cameras * sizeof(Camera));
for (long long c = 0; c < n_cameras; c++) cameras[c] = camera_at(c);
