// The adjoint of `projection.cpp`.

void project_backward(
    long long n,
    long long n_cameras,
#include "gaussian_parameters.inc"
    long long ortho,         // 1: x = fx X + cx, y = fy Y + cy, whatever the depth
    const int* radii,        // [C, n, 2]; 0 where nothing was drawn
    const float* g_means2d,  // [C, n, 2], or null for zeros, as the next two
#include "gradient_parameters.inc"
    float* g_viewmats,      // [C, 4, 4]
    double* chunk_cameras,  // [C, chunks, 12]: by the upper three rows of viewmats, of each chunk
    long long* state        // [STATE], zeros
) {
#pragma clang fp contract(fast)
#include "projection_vectors.h"
    const I moving = (I)(ortho ? 0 : -1);  // whether J changes with the point
    struct From {
        const float *means, *quats, *scales, *covars;
    };
    struct Spare {
        double g_covars2d[24];
        float means[24], quats[32], scales[24], covars[72], g_means2d[16], g_depths[8];
        float to_means[24], to_quats[32], to_scales[24], to_covars[72];
        int radii[16];
    };
    const bool of_shape = g_quats || g_scales || g_covars, of_place = g_means || g_viewmats;
    const long long n_sums = g_viewmats ? 96 * n_cameras : 0;  // by camera and matrix entry, one a lane
    double* sums = (double*)malloc(n_sums * sizeof(double));

    phase(state, n_chunks, [&](long long chunk) {
        const long long first = chunk * CHUNK, end = first + CHUNK < n ? first + CHUNK : n;
        memset(sums, 0, n_sums * sizeof(double));
        Spare spare;

        for (long long i = first; i < end; i += 8) {
            const int count = end - i < 8 ? (int)(end - i) : 8;
            const bool whole = count == 8;
            From from = {means + 3 * i, quats + 4 * i, scales + 3 * i, covars + 9 * i};
            if (!whole) {  // lanes behind the end stay 0: nothing was drawn there
                memset(&spare, 0, sizeof spare);
                auto fill = [&](float* spare, const float*& from, int size) {
                    from = (const float*)memcpy(spare, from, size * count * sizeof(float));
                };
                fill(spare.means, from.means, 3);
                if (covars)
                    fill(spare.covars, from.covars, 9);
                else
                    fill(spare.quats, from.quats, 4), fill(spare.scales, from.scales, 3);
            }
            F a, b, c, d;
            load3(from.means, a, b, c);
            const V mean[3] = {wide(a), wide(b), wide(c)};
            V w, x, y, z, inverse_norm, r[9], scale[3], s[6];  // s: covariance xx, xy, xz, yy, yz, zz
            bool loaded = false;
            I touched = (I)(0);
            V g_mean[3] = {}, g_s[6] = {};  // by the mean and the covariance

            for (long long camera = 0; camera < n_cameras; camera++) {
                const Camera& k = cameras[camera];
                const long long at = camera * n + i;
                const int* drawn = radii + 2 * at;
                const float *of_means2d = g_means2d + 2 * at, *of_depths = g_depths + at;
                const double* of_covars2d = g_covars2d + 3 * at;
                if (!whole) {
                    drawn = (const int*)memcpy(spare.radii, drawn, 2 * count * sizeof(int));
                    if (g_means2d)
                        of_means2d = (const float*)memcpy(spare.g_means2d, of_means2d, 2 * count * sizeof(float));
                    if (g_covars2d)
                        of_covars2d = (const double*)memcpy(spare.g_covars2d, of_covars2d, 3 * count * sizeof(double));
                    if (g_depths) of_depths = (const float*)memcpy(spare.g_depths, of_depths, count * sizeof(float));
                }
                V g_x = (V)(0.0), g_y = g_x, g_depth = g_x, g_xx = g_x, g_xy = g_x, g_yy = g_x;
                load2((const float*)drawn, a, b);
                I active = __builtin_convertvector(__builtin_bit_cast(N, a) != 0, I);
                if (g_means2d) {
                    load2(of_means2d, a, b);
                    g_x = wide(a);
                    g_y = wide(b);
                }
                if (g_covars2d) {
                    const V front = *(const VU*)of_covars2d, middle = *(const VU*)(of_covars2d + 8);
                    const V back = *(const VU*)(of_covars2d + 16);
                    const V xs = __builtin_shufflevector(front, middle, 0, 3, 6, 9, 12, 15, -1, -1);
                    const V xys = __builtin_shufflevector(front, middle, 1, 4, 7, 10, 13, -1, -1, -1);
                    const V ys = __builtin_shufflevector(front, middle, 2, 5, 8, 11, 14, -1, -1, -1);
                    g_xx = __builtin_shufflevector(xs, back, 0, 1, 2, 3, 4, 5, 10, 13);
                    g_xy = __builtin_shufflevector(xys, back, 0, 1, 2, 3, 4, 8, 11, 14);
                    g_yy = __builtin_shufflevector(ys, back, 0, 1, 2, 3, 4, 9, 12, 15);
                }
                if (g_depths) g_depth = wide(*(const FU*)of_depths);
                active &= (g_x != 0.0) | (g_y != 0.0) | (g_xx != 0.0) | (g_xy != 0.0) | (g_yy != 0.0);
                V g_point[3] = {(V)(0.0), (V)(0.0), g_depth};

                if (__builtin_reduce_or(active)) {
                    if (!loaded) {
                        loaded = true;
                        if (covars)
                            load_covariance(from.covars, s);
                        else {
                            load4(from.quats, a, b, c, d);
                            w = wide(a);
                            x = wide(b);
                            y = wide(c);
                            z = wide(d);
                            inverse_norm = rotation(w, x, y, z, r);
                            load3(from.scales, a, b, c);
                            scale[0] = wide(a);
                            scale[1] = wide(b);
                            scale[2] = wide(c);
#include "covariance3d.h"
                        }
                    }
                    touched |= active;
                    auto kept = [&](V value) -> V { return active ? value : (V)(0.0); };
                    g_x = kept(g_x);
                    g_y = kept(g_y);
                    g_xx = kept(g_xx);
                    g_xy = 0.5 * kept(g_xy);
                    g_yy = kept(g_yy);
                    const V px = k.r[0] * mean[0] + k.r[1] * mean[1] + k.r[2] * mean[2] + k.t[0];
                    const V py = k.r[3] * mean[0] + k.r[4] * mean[1] + k.r[5] * mean[2] + k.t[1];
                    const V pz = k.r[6] * mean[0] + k.r[7] * mean[1] + k.r[8] * mean[2] + k.t[2];
                    const V inverse = ortho ? (V)(1.0) : 1.0 / (active ? pz : (V)(1.0)), u = px * inverse,
                            v = py * inverse;
                    V slope_u, slope_v, j0, j1, b0[3], b1[3], g_b0[3], g_b1[3];
#include "jacobian.h"
                    for (int e = 0; e < 3; e++) {
                        g_b0[e] = g_xx * b0[e] + g_xy * b1[e];  // rows of G B, below times 2 covariance
                        g_b1[e] = g_xy * b0[e] + g_yy * b1[e];
                    }
                    if (of_shape) {
                        int e = 0;
                        for (int row = 0; row < 3; row++)
                            for (int column = row; column < 3; column++, e++)
                                g_s[e] += b0[row] * g_b0[column] + b1[row] * g_b1[column];
                    }
                    if (of_place) {
#include "point_gradient.h"
                        g_point[0] = kept(inverse * g_u);
                        g_point[1] = kept(inverse * g_v);
                        g_point[2] -= kept(moving ? inverse * (g_u * u + g_v * v + inverse * g_inverse) : (V)(0.0));
                        if (g_viewmats)
                            for (int column = 0; column < 3; column++) {
                                VU* to = (VU*)(sums + 96 * camera) + column;
                                const V first_row = j0 * g_b0[column], second_row = j1 * g_b1[column];
                                to[0] += kept(first_row);
                                to[4] += kept(second_row);
                                to[8] -= kept(slope_u * first_row + slope_v * second_row);
                            }
                    }
                }
                if (g_viewmats)
                    for (int row = 0; row < 3; row++) {
                        VU* to = (VU*)(sums + 96 * camera) + 4 * row;
                        const V g = g_point[row];
                        for (int column = 0; column < 3; column++) to[column] += g != 0.0 ? g * mean[column] : (V)(0.0);
                        to[3] += g;
                    }
                for (int e = 0; e < 3; e++)
                    g_mean[e] += k.r[e] * g_point[0] + k.r[3 + e] * g_point[1] + k.r[6 + e] * g_point[2];
            }

            if (g_means) {
                float* to = whole ? g_means + 3 * i : spare.to_means;
                store3(to, narrow(g_mean[0]), narrow(g_mean[1]), narrow(g_mean[2]));
                if (!whole) memcpy(g_means + 3 * i, to, 3 * count * sizeof(float));
            }
            if (!loaded) {
                if (g_quats) memset(g_quats + 4 * i, 0, 4 * count * sizeof(float));
                if (g_scales) memset(g_scales + 3 * i, 0, 3 * count * sizeof(float));
                if (g_covars) memset(g_covars + 9 * i, 0, 9 * count * sizeof(float));
                continue;
            }
            auto kept = [&](V value) -> F { return narrow(touched ? value : (V)(0.0)); };
            const V g[9] = {g_s[0], g_s[1], g_s[2], g_s[1], g_s[3], g_s[4], g_s[2], g_s[4], g_s[5]};
            if (g_covars) {
                float* to = whole ? g_covars + 9 * i : spare.to_covars;
                for (int e = 0; e < 9; e++) {
                    const F entry = kept(g[e]);
                    for (int lane = 0; lane < 8; lane++) to[9 * lane + e] = entry[lane];
                }
                if (!whole) memcpy(g_covars + 9 * i, to, 9 * count * sizeof(float));
            }
            if (g_quats || g_scales) {
                V h[9], g_scale[3];  // h = 2 g R: by F = R S it is h S, by R itself h S S
                for (int row = 0; row < 3; row++)
                    for (int column = 0; column < 3; column++) {
                        const V half =
                            g[3 * row] * r[column] + g[3 * row + 1] * r[3 + column] + g[3 * row + 2] * r[6 + column];
                        h[3 * row + column] = half + half;
                    }
                for (int e = 0; e < 3; e++) {
                    g_scale[e] = scale[e] * (r[e] * h[e] + r[3 + e] * h[3 + e] + r[6 + e] * h[6 + e]);
                    const V square = scale[e] * scale[e];
                    for (int row = 0; row < 3; row++) h[3 * row + e] *= square;
                }
                if (g_scales) {
                    float* to = whole ? g_scales + 3 * i : spare.to_scales;
                    store3(to, kept(g_scale[0]), kept(g_scale[1]), kept(g_scale[2]));
                    if (!whole) memcpy(g_scales + 3 * i, to, 3 * count * sizeof(float));
                }
                if (g_quats) {
#include "quaternion_gradient.h"
                    float* to = whole ? g_quats + 4 * i : spare.to_quats;
                    store4(to, kept(g_quat[0]), kept(g_quat[1]), kept(g_quat[2]), kept(g_quat[3]));
                    if (!whole) memcpy(g_quats + 4 * i, to, 4 * count * sizeof(float));
                }
            }
        }
        for (long long k = 0; k < n_sums; k += 8) {
            double total = 0.0;
            for (int lane = 0; lane < 8; lane++) total += sums[k + lane];
            chunk_cameras[(k / 96 * n_chunks + chunk) * 12 + k % 96 / 8] = total;
        }
    });
    free(sums);
    free(cameras);

    phase(state + PHASE_WORDS, g_viewmats ? n_cameras : 0, [&](long long c) {
        for (int e = 0; e < 16; e++) {
            double total = 0.0;
            if (e < 12)
                for (long long k = 0; k < n_chunks; k++) total += chunk_cameras[(c * n_chunks + k) * 12 + e];
            g_viewmats[16 * c + e] = (float)total;  // the last row is not read
        }
    });
}
