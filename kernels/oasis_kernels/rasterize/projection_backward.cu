// One thread per Gaussian, which adds its cameras in order.
__global__ void project_backward(
    int n,
    int n_cameras,
#include "gaussian_parameters.inc"
    int ortho,                // 1: x = fx X + cx, y = fy Y + cy, whatever the depth
    const int2* radii,        // [C, n]
    const float2* g_means2d,  // [C, n], or null for zeros, as the next two
#include "gradient_parameters.inc"
    double* g_cameras  // [C, n, 12]: by the upper three rows of viewmats, of each Gaussian
) {
#include "projection_cuda.h"
    if (thread >= n) return;
    const int i = thread;
    const bool of_place = g_means || g_cameras, moving = !ortho;
    const double mean[3] = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
    double r[9], scale[3], s[6], inverse_norm = 0.0;  // s: covariance xx, xy, xz, yy, yz, zz
    double w = 1.0, x = 0.0, y = 0.0, z = 0.0;
    bool loaded = false;
    double g_mean[3] = {}, g_s[6] = {};  // by the mean and the covariance

    for (int c = 0; c < n_cameras; c++) {
        const long long at = (long long)c * n + i;
        double g_x = 0.0, g_y = 0.0, g_xx = 0.0, g_xy = 0.0, g_yy = 0.0;
        if (g_means2d) {
            const float2 g = g_means2d[at];
            g_x = g.x;
            g_y = g.y;
        }
        if (g_covars2d) {
            g_xx = g_covars2d[3 * at];
            g_xy = 0.5 * g_covars2d[3 * at + 1];
            g_yy = g_covars2d[3 * at + 2];
        }
        double g_point[3] = {0.0, 0.0, g_depths ? (double)g_depths[at] : 0.0};
        double g_b0[3] = {}, g_b1[3] = {}, j0 = 0.0, j1 = 0.0, slope_u = 0.0, slope_v = 0.0;
        const bool active = radii[at].x > 0 && (g_x != 0.0 || g_y != 0.0 || g_xx != 0.0 || g_xy != 0.0 || g_yy != 0.0);
        const Camera k = camera_at(c);
        if (active) {
            if (!loaded) {
                loaded = true;
                if (covars)
                    load_covariance(i, s);
                else {
                    w = quats[4 * i];
                    x = quats[4 * i + 1];
                    y = quats[4 * i + 2];
                    z = quats[4 * i + 3];
                    inverse_norm = rotation(w, x, y, z, r);
                    for (int e = 0; e < 3; e++) scale[e] = scales[3 * i + e];
#include "covariance3d.h"
                }
            }
            const double px = k.r[0] * mean[0] + k.r[1] * mean[1] + k.r[2] * mean[2] + k.t[0];
            const double py = k.r[3] * mean[0] + k.r[4] * mean[1] + k.r[5] * mean[2] + k.t[1];
            const double pz = k.r[6] * mean[0] + k.r[7] * mean[1] + k.r[8] * mean[2] + k.t[2];
            const double inverse = ortho ? 1.0 : reciprocal(pz), u = px * inverse, v = py * inverse;
            double b0[3], b1[3];
#include "jacobian.h"
            for (int e = 0; e < 3; e++) {
                g_b0[e] = g_xx * b0[e] + g_xy * b1[e];  // rows of G B, below times 2 covariance
                g_b1[e] = g_xy * b0[e] + g_yy * b1[e];
            }
            int e = 0;
            for (int row = 0; row < 3; row++)
                for (int column = row; column < 3; column++, e++)
                    g_s[e] += b0[row] * g_b0[column] + b1[row] * g_b1[column];
            if (of_place) {
#include "point_gradient.h"
                g_point[0] = inverse * g_u;
                g_point[1] = inverse * g_v;
                if (!ortho) g_point[2] -= inverse * (g_u * u + g_v * v + inverse * g_inverse);
            }
        }
        for (int e = 0; e < 3; e++)
            g_mean[e] += k.r[e] * g_point[0] + k.r[3 + e] * g_point[1] + k.r[6 + e] * g_point[2];
        if (g_cameras) {
            double* to = g_cameras + 12 * at;
            for (int e = 0; e < 3; e++) {
                const double first_row = j0 * g_b0[e], second_row = j1 * g_b1[e];
                // Without a gradient there may be no number either, where the caller did not want to be checked.
                auto by = [&](int row) -> double { return g_point[row] != 0.0 ? g_point[row] * mean[e] : 0.0; };
                to[e] = by(0) + first_row;
                to[4 + e] = by(1) + second_row;
                to[8 + e] = by(2) - (slope_u * first_row + slope_v * second_row);
                to[4 * e + 3] = g_point[e];
            }
        }
    }

    if (g_means)
        for (int e = 0; e < 3; e++) g_means[3 * i + e] = (float)g_mean[e];
    const double g[9] = {g_s[0], g_s[1], g_s[2], g_s[1], g_s[3], g_s[4], g_s[2], g_s[4], g_s[5]};
    if (g_covars)
        for (int e = 0; e < 9; e++) g_covars[9 * (long long)i + e] = (float)g[e];
    if (!loaded) {
        if (g_quats)
            for (int e = 0; e < 4; e++) g_quats[4 * i + e] = 0.f;
        if (g_scales)
            for (int e = 0; e < 3; e++) g_scales[3 * i + e] = 0.f;
    } else if (g_quats || g_scales) {
        double h[9];  // 2 g R: by F = R S it is h S, by R itself h S S
        for (int row = 0; row < 3; row++)
            for (int column = 0; column < 3; column++)
                h[3 * row + column] =
                    2.0 * (g[3 * row] * r[column] + g[3 * row + 1] * r[3 + column] + g[3 * row + 2] * r[6 + column]);
        for (int e = 0; e < 3; e++) {
            if (g_scales)
                g_scales[3 * i + e] = (float)(scale[e] * (r[e] * h[e] + r[3 + e] * h[3 + e] + r[6 + e] * h[6 + e]));
            const double square = scale[e] * scale[e];
            for (int row = 0; row < 3; row++) h[3 * row + e] *= square;
        }
        if (g_quats) {
#include "quaternion_gradient.h"
            for (int e = 0; e < 4; e++) g_quats[4 * i + e] = (float)g_quat[e];
        }
    }
}
