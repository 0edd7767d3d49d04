// Colours of Gaussians from spherical harmonics on CUDA: `spherical_harmonics.sh_to_rgb` and its adjoint over raw
// pointers.
//
// `sh_to_rgb` takes one thread for each camera and Gaussian, its adjoint one for each Gaussian, which goes through the
// cameras in order, so that no sum depends on how threads run.

__global__ void sh_to_rgb(
#include "sh_parameters.inc"
    int total, float* colors
) {
#include "sh_basis.h"
    if (thread < total) {
        const int camera = thread / n;
        float d[3], b[16], sum[3] = {0.f, 0.f, 0.f};
        direction(camera, thread - camera * n, d);
        basis(d, b);
        const float* const own = coefficients + (long long)(thread % rows) * 3 * n_harmonics;
        for (int k = 0; k < COUNT; k++)
            for (int e = 0; e < 3; e++) sum[e] += b[k] * own[3 * k + e];
        for (int e = 0; e < 3; e++) {
            const float color = sum[e] + 0.5f;
            colors[3 * (long long)thread + e] = color < 0.f ? 0.f : color;  // NaN stays
        }
    }
}

__global__ void sh_to_rgb_backward(
#include "sh_parameters.inc"
    int n_cameras, const float* colors, const float* g_colors, float* g_means, float* g_coefficients, double* g_centers
) {
#include "sh_basis.h"
    auto basis_adjoint = [](const float* d, const float* g, float* out) {
        const float x = d[0], y = d[1], z = d[2];
        out[0] = out[1] = out[2] = 0.f;
        if (DEGREE > 0) {
            out[0] -= L1 * g[3];
            out[1] -= L1 * g[1];
            out[2] += L1 * g[2];
        }
        if (DEGREE > 1) {
            out[0] += L2_XY * (g[4] * y - g[7] * z) + 2.f * L2_XX * g[8] * x;
            out[1] += L2_XY * (g[4] * x - g[5] * z) - 2.f * L2_XX * g[8] * y;
            out[2] += 6.f * L2_ZZ * g[6] * z - L2_XY * (g[5] * y + g[7] * x);
        }
        if (DEGREE > 2) {
            const float xx = x * x, yy = y * y, zz = z * z, ring = 5.f * zz - 1.f, across = 3.f * (xx - yy);
            out[0] += L3_XYZ * g[10] * y * z - L3_XXX * (6.f * g[9] * x * y + g[15] * across) - L3_YZZ * g[13] * ring +
                      2.f * L3_XXZ * g[14] * x * z;
            out[1] += L3_XYZ * g[10] * x * z - L3_XXX * (g[9] * across - 6.f * g[15] * x * y) - L3_YZZ * g[11] * ring -
                      2.f * L3_XXZ * g[14] * y * z;
            out[2] += L3_XYZ * g[10] * x * y - 10.f * L3_YZZ * z * (g[11] * y + g[13] * x) +
                      L3_XXZ * g[14] * (xx - yy) + L3_ZZZ * g[12] * (15.f * zz - 3.f);
        }
    };

    if (thread < n) {
        double g_mean[3] = {0.0, 0.0, 0.0};
        for (int camera = 0; camera < n_cameras; camera++) {
            const int i = camera * n + thread, row = i % rows;
            float d[3], b[16], g[3];
            const float norm = direction(camera, thread, d);
            for (int e = 0; e < 3; e++)
                g[e] = colors[3 * (long long)i + e] > 0.f ? g_colors[3 * (long long)i + e] : 0.f;
            const long long at = (long long)row * 3 * n_harmonics;
            if (g_coefficients) {
                float* const to = g_coefficients + at;
                const bool first = row == i;
                basis(d, b);
                for (int k = 0; k < COUNT; k++)
                    for (int e = 0; e < 3; e++) to[3 * k + e] = (first ? 0.f : to[3 * k + e]) + b[k] * g[e];
                if (first)
                    for (int k = 3 * COUNT; k < 3 * n_harmonics; k++) to[k] = 0.f;
            }
            if (g_means || g_centers) {
                const float* const own = coefficients + at;
                float g_unit[3];
                for (int k = 0; k < COUNT; k++)
                    b[k] = own[3 * k] * g[0] + own[3 * k + 1] * g[1] + own[3 * k + 2] * g[2];
                basis_adjoint(d, b, g_unit);
                const float along = g_unit[0] * d[0] + g_unit[1] * d[1] + g_unit[2] * d[2];
                for (int e = 0; e < 3; e++) {
                    const float g_direction = norm > 0.f ? (g_unit[e] - along * d[e]) / norm : 0.f;
                    g_mean[e] += g_direction;
                    if (g_centers) g_centers[3 * (long long)i + e] = -(double)g_direction;
                }
            }
        }
        if (g_means)
            for (int e = 0; e < 3; e++) g_means[3 * (long long)thread + e] = (float)g_mean[e];
    }
}
