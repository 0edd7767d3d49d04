// From a camera to a Gaussian, of length 1, or 0 where they meet; returns the length it had. A far camera's centre
// cancels against the Gaussian's in float32.
auto direction = [&](int camera, int gaussian, float* d) -> float {
    double r[12];
    for (int e = 0; e < 12; e++) r[e] = poses[16 * (long long)camera + e];
    const double *a = r, *b = r + 4, *c = r + 8;
    double across[3][3];
    for (int e = 0; e < 3; e++) {
        const int f = (e + 1) % 3, g = (e + 2) % 3;
        across[0][e] = b[f] * c[g] - b[g] * c[f];
        across[1][e] = c[f] * a[g] - c[g] * a[f];
        across[2][e] = a[f] * b[g] - a[g] * b[f];
    }
    const double volume = a[0] * across[0][0] + a[1] * across[0][1] + a[2] * across[0][2];
    for (int e = 0; e < 3; e++) {
        const double center = -(a[3] * across[0][e] + b[3] * across[1][e] + c[3] * across[2][e]) / volume;
        d[e] = (float)((double)means[3 * (long long)gaussian + e] - center);
    }
    const float peak = fmaxf(fmaxf(fabsf(d[0]), fabsf(d[1])), fabsf(d[2]));
    if (!(peak > 0.f)) {
        d[0] = d[1] = d[2] = 0.f;
        return 0.f;
    }
    for (int e = 0; e < 3; e++) d[e] /= peak;
    const float length = sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (int e = 0; e < 3; e++) d[e] /= length;
    return peak * length;
};
auto basis = [](const float* d, float* b) {
    const float x = d[0], y = d[1], z = d[2];
    b[0] = L0;
    if (DEGREE > 0) {
        b[1] = -L1 * y;
        b[2] = L1 * z;
        b[3] = -L1 * x;
    }
    if (DEGREE > 1) {
        b[4] = L2_XY * x * y;
        b[5] = -L2_XY * y * z;
        b[6] = L2_ZZ * (3.f * z * z - 1.f);
        b[7] = -L2_XY * x * z;
        b[8] = L2_XX * (x * x - y * y);
    }
    if (DEGREE > 2) {
        b[9] = -L3_XXX * y * (3.f * x * x - y * y);
        b[10] = L3_XYZ * x * y * z;
        b[11] = -L3_YZZ * y * (5.f * z * z - 1.f);
        b[12] = L3_ZZZ * z * (5.f * z * z - 3.f);
        b[13] = -L3_YZZ * x * (5.f * z * z - 1.f);
        b[14] = L3_XXZ * z * (x * x - y * y);
        b[15] = -L3_XXX * x * (x * x - 3.f * y * y);
    }
};
