typedef double V;
// Full precision from approximations of 20 bits, by two steps of Newton's.
auto reciprocal = [](double x) -> double {
    double r;
    asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(x));
    r = fma(r, fma(-x, r, 1.0), r);
    return fma(r, fma(-x, r, 1.0), r);
};
auto inverse_root = [](double x) -> double {
    double r;
    asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(x));
    r = fma(0.5 * r, fma(-x * r, r, 1.0), r);
    return fma(0.5 * r, fma(-x * r, r, 1.0), r);
};
auto quotient = [&](double a, double b) -> double { return a * reciprocal(b); };
#include "projection.h"
// Symmetric part: xx, xy, xz, yy, yz, zz.
auto load_covariance = [&](int i, double* s) {
    const float* p = covars + 9 * (long long)i;
    s[0] = p[0];
    s[1] = 0.5 * ((double)p[1] + (double)p[3]);
    s[2] = 0.5 * ((double)p[2] + (double)p[6]);
    s[3] = p[4];
    s[4] = 0.5 * ((double)p[5] + (double)p[7]);
    s[5] = p[8];
};
