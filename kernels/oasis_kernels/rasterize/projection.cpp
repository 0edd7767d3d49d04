// Float32 projection on the CPU, eight Gaussians at once: what forward and backward share.
//
// A task is a chunk of `CHUNK` Gaussians, through all cameras. Arithmetic is float64 as in the generic kernels, eight
// lanes per vector, so that the two agree to the rounding of the stored float32. A block of fewer than eight Gaussians
// at the end of the arrays is copied to and from buffers of eight on the stack: nothing outside the arrays is read or
// written, and the same instructions compute every Gaussian, wherever it stands.
//
// Both passes use factors: covariance = F F^T with F = R(q) S, or F the Cholesky factor of a given covariance. With B
// the 2 x 3 matrix J R_camera and M = B F, the covariance in the image is M M^T + eps2d (Zwicker et al. 2001, eq. 31).
// The adjoint is B^T G B by the covariance and 2 G B covariance by B, where G is the symmetric gradient in the image.

void project(
    long long n,
    long long n_cameras,
#include "gaussian_parameters.inc"
    long long ortho,         // 1: x = fx X + cx, y = fy Y + cy, whatever the depth
    const float* opacities,  // [n]
    const double* limits,    // near, far, radius_clip, eps2d, alpha_min, extent_sigmas, largest magnitude
    float* means2d,          // [C, n, 2]
    double* covars2d,        // [C, n, 3]
    float* depths,           // [C, n]
    float* conics,           // [C, n, 3]
    int* radii,              // [C, n, 2]
    double* sort_depths,     // [C, n]
    float* centers,          // [C, n, 4]
    float* whitenings,       // [C, n, 4]
    int* boxes,              // [C, n, 4]
    long long* bad,          // made 1 where an input is not finite, beyond the largest magnitude or outside its range
    long long* state         // [PHASE_WORDS], zeros
) {
#pragma clang fp contract(fast)
#include "projection_vectors.h"
    // log of x >= 1, by 2 atanh((m - 1) / (m + 1)) with m within a factor sqrt(2) of 1; relative error 1e-12.
    auto logarithm = [](V x) -> V {
        const I bits = __builtin_bit_cast(I, x), power = (bits - 0x3fe6a09e667f3bcdll) >> 52;
        const V m = __builtin_bit_cast(V, bits - (power << 52)), t = (m - 1.0) / (m + 1.0), s = t * t;
        V series = s * (1.0 / 13.0) + 1.0 / 11.0;
        series = series * s + 1.0 / 9.0;
        series = series * s + 1.0 / 7.0;
        series = series * s + 1.0 / 5.0;
        series = series * s + 1.0 / 3.0;
        series = series * s + 1.0;
        const V whole = __builtin_bit_cast(V, power + 0x4338000000000000ll) - 6755399441055744.0;
        return whole * 0.6931471805599453 + (t + t) * series;
    };
    // Columns of F with F F^T = s, by Cholesky with the largest diagonal first, which bears matrices without full rank
    // and those that rounding has made indefinite.
    auto factor = [](V* s, V* f) {
        const V zero = (V)(0.0);
        I is[3];
        for (int column = 0; column < 3; column++) {
            V d = s[0];
            is[0] = ~(I)(0);
            is[1] = s[3] > d;
            d = is[1] ? s[3] : d;
            is[2] = s[5] > d;
            d = is[2] ? s[5] : d;
            is[1] &= ~is[2];
            is[0] = ~(is[1] | is[2]);
            const V v[3] = {
                is[0]   ? s[0]
                : is[1] ? s[1]
                        : s[2],
                is[0]   ? s[1]
                : is[1] ? s[3]
                        : s[4],
                is[0]   ? s[2]
                : is[1] ? s[4]
                        : s[5]
            };
            const I some = d > 0.0;
            const V root = 1.0 / __builtin_elementwise_sqrt(some ? d : (V)(1.0));
            for (int row = 0; row < 3; row++) f[3 * row + column] = some ? v[row] * root : zero;
            int k = 0;
            for (int i = 0; i < 3; i++)
                for (int j = i; j < 3; j++, k++)
                    s[k] = (is[i] | is[j] | ~some) ? zero : s[k] - f[3 * i + column] * f[3 * j + column];
        }
    };
    const double near = limits[0], far = limits[1], radius_clip = limits[2], eps2d = limits[3], alpha_min = limits[4];
    const V reach_limit = (V)(limits[5] * limits[5]);
    const F magnitude = (F)((float)limits[6]);
    auto unsound = [&](F a) -> N { return ~(__builtin_elementwise_abs(a) <= magnitude); };
    N camera_flaws = (N)(0);
    for (long long c = 0; c < n_cameras; c++) {
        for (int k = 0; k < 16; k++) camera_flaws |= unsound((F)(viewmats[16 * c + k]));
        for (int k = 0; k < 9; k++) camera_flaws |= unsound((F)(Ks[9 * c + k]));
        if (Ks[9 * c] == 0.f || Ks[9 * c + 4] == 0.f) camera_flaws |= (N)(1);
    }

    struct From {
        const float *means, *quats, *scales, *covars, *opacities;
    };
    struct To {
        double *covars2d, *sort_depths;
        float *means2d, *depths, *conics, *centers, *whitenings;
        int *radii, *boxes;
    };
    struct Spare {
        double covars2d[24], sort_depths[8];
        float in_means[24], in_quats[32], in_scales[24], in_covars[72], in_opacities[8];
        float means2d[16], depths[8], conics[24], centers[32], whitenings[32];
        int radii[16], boxes[32];
    };

    phase(state, n_chunks, [&](long long chunk) {
        const long long first = chunk * CHUNK, end = first + CHUNK < n ? first + CHUNK : n;
        N flaws = camera_flaws;
        Spare spare;

        for (long long i = first; i < end; i += 8) {
            const int count = end - i < 8 ? (int)(end - i) : 8;
            const bool whole = count == 8;
            From from = {means + 3 * i, quats + 4 * i, scales + 3 * i, covars + 9 * i, opacities + i};
            if (!whole) {  // fill the lanes behind the end with the last Gaussian
                auto fill = [&](float* spare, const float*& from, int size) {
                    for (int lane = 0; lane < 8; lane++) {
                        const int row = lane < count ? lane : count - 1;
                        memcpy(spare + lane * size, from + row * size, size * sizeof(float));
                    }
                    from = spare;
                };
                fill(spare.in_means, from.means, 3);
                fill(spare.in_opacities, from.opacities, 1);
                if (covars)
                    fill(spare.in_covars, from.covars, 9);
                else
                    fill(spare.in_quats, from.quats, 4), fill(spare.in_scales, from.scales, 3);
            }

            F a, b, c, d;
            V f[9];
            if (covars) {
                V s[6];
                load_covariance(from.covars, s);
                for (int k = 0; k < 9; k++) flaws |= unsound(*(const FU*)(from.covars + 8 * k));
                flaws |= (narrow(s[0]) < 0.f) | (narrow(s[3]) < 0.f) | (narrow(s[5]) < 0.f);
                factor(s, f);
            } else {
                load4(from.quats, a, b, c, d);
                flaws |= unsound(a) | unsound(b) | unsound(c) | unsound(d);
                flaws |= (a == 0.f) & (b == 0.f) & (c == 0.f) & (d == 0.f);
                rotation(wide(a), wide(b), wide(c), wide(d), f);
                load3(from.scales, a, b, c);
                flaws |= unsound(a) | unsound(b) | unsound(c);
                const V scale[3] = {wide(a), wide(b), wide(c)};
                for (int k = 0; k < 9; k++) f[k] *= scale[k % 3];
            }
            load3(from.means, a, b, c);
            flaws |= unsound(a) | unsound(b) | unsound(c);
            const V X = wide(a), Y = wide(b), Z = wide(c);
            a = *(const FU*)from.opacities;
            flaws |= ~((a >= 0.f) & (a <= 1.f));
            const V opacity = wide(a);
            const I bright = opacity >= alpha_min;
            const V ratio = opacity * (1.0 / alpha_min);
            V reach = logarithm(ratio > 1.0 ? ratio : (V)(1.0));  // squared, in standard deviations
            reach = reach + reach < reach_limit ? reach + reach : reach_limit;

            for (long long camera = 0; camera < n_cameras; camera++) {
                const Camera& k = cameras[camera];
                const long long at = camera * n + i;
                To to = {covars2d + 3 * at, sort_depths + at,    means2d + 2 * at, depths + at,   conics + 3 * at,
                         centers + 4 * at,  whitenings + 4 * at, radii + 2 * at,   boxes + 4 * at};
                if (!whole)
                    to = {spare.covars2d, spare.sort_depths, spare.means2d, spare.depths, spare.conics,
                          spare.centers,  spare.whitenings,  spare.radii,   spare.boxes};

                const V px = k.r[0] * X + k.r[1] * Y + k.r[2] * Z + k.t[0];
                const V py = k.r[3] * X + k.r[4] * Y + k.r[5] * Z + k.t[1];
                const V pz = k.r[6] * X + k.r[7] * Y + k.r[8] * Z + k.t[2];
                *(FU*)to.depths = narrow(pz);
                *(VU*)to.sort_depths = pz;
                // Comparisons are written so that a NaN, where the caller did not want to be checked, is not drawn.
                I drawn = (pz >= near) & (pz <= far) & bright;
                if (__builtin_reduce_or(drawn)) {
                    const V inverse = ortho ? (V)(1.0) : 1.0 / (drawn ? pz : (V)(1.0)), u = px * inverse,
                            v = py * inverse;
                    V slope_u, slope_v, j0, j1, b0[3], b1[3], xx, xy, yy, det;
#include "jacobian.h"
#include "covariance2d.h"
                    const V x = k.fx * u + k.cx, y = k.fy * v + k.cy;
                    const V extent_x = __builtin_elementwise_sqrt(reach * xx);
                    const V extent_y = __builtin_elementwise_sqrt(reach * yy);
                    V radius_x = __builtin_elementwise_ceil(extent_x), radius_y = __builtin_elementwise_ceil(extent_y);
                    radius_x = radius_x > 1.0 ? radius_x : (V)(1.0);
                    radius_y = radius_y > 1.0 ? radius_y : (V)(1.0);
                    drawn &= (det > 0.0) & ((radius_x > radius_clip) | (radius_y > radius_clip));
                    drawn &= (x + radius_x > 0.0) & (x - radius_x < width);
                    drawn &= (y + radius_y > 0.0) & (y - radius_y < height);

                    auto kept = [&](V a) -> V { return drawn ? a : (V)(0.0); };
                    auto whole_number = [&](V a) -> F {
                        return __builtin_bit_cast(F, __builtin_convertvector(kept(a), N));
                    };
                    // First and past-the-last pixel whose centre is within the extent, clamped before it is an integer.
                    auto low = [](V at, V extent, double size) -> V {
                        const V a = __builtin_elementwise_ceil(at - extent - 0.5);
                        return a < 0.0 ? (V)(0.0) : a > size ? (V)(size) : a;
                    };
                    auto high = [](V at, V extent, double size) -> V {
                        const V a = __builtin_elementwise_floor(at + extent + 0.5);
                        return a < 0.0 ? (V)(0.0) : a > size ? (V)(size) : a;
                    };
                    const V slack_x = extent_x * (1.0 + BOX_SLACK) + BOX_SLACK;
                    const V slack_y = extent_y * (1.0 + BOX_SLACK) + BOX_SLACK;
                    const F x0 = whole_number(low(x, slack_x, width)), x1 = whole_number(high(x, slack_x, width));
                    const F y0 = whole_number(low(y, slack_y, height)), y1 = whole_number(high(y, slack_y, height));
                    store4((float*)to.boxes, x0, y0, x1, y1);
                    const V largest = (V)(2147483647.0);
                    store2(
                        (float*)to.radii, whole_number(radius_x < largest ? radius_x : largest),
                        whole_number(radius_y < largest ? radius_y : largest)
                    );
                    store2(to.means2d, narrow(kept(x)), narrow(kept(y)));
                    const F floor_x = narrow(kept(__builtin_elementwise_floor(x)));
                    const F floor_y = narrow(kept(__builtin_elementwise_floor(y)));
                    store4(
                        to.centers, floor_x, floor_y, narrow(kept(x) - wide(floor_x)), narrow(kept(y) - wide(floor_y))
                    );

                    const V sound = drawn ? det : (V)(1.0), inverse_det = 1.0 / sound;
                    store3(
                        to.conics, narrow(kept(yy * inverse_det)), narrow(kept(-xy * inverse_det)),
                        narrow(kept(xx * inverse_det))
                    );
                    // Cholesky factor of the inverse, pivoted on the larger diagonal.
                    const I across = xx >= yy;
                    const V pivot = drawn ? (across ? xx : yy) : (V)(1.0);
                    const V h = 1.0 / __builtin_elementwise_sqrt(pivot);
                    const V tall = __builtin_elementwise_sqrt(pivot * inverse_det), sheared = -tall * xy * (h * h);
                    store4(
                        to.whitenings, narrow(kept(across ? h : (V)(0.0))), narrow(kept(across ? (V)(0.0) : h)),
                        narrow(kept(across ? sheared : tall)), narrow(kept(across ? tall : sheared))
                    );
                    const V rows[3] = {kept(xx), kept(xy), kept(yy)};
                    const V front = __builtin_shufflevector(rows[0], rows[1], 0, 8, -1, 1, 9, -1, 2, 10);
                    const V middle = __builtin_shufflevector(rows[0], rows[1], -1, 3, 11, -1, 4, 12, -1, 5);
                    const V back = __builtin_shufflevector(rows[0], rows[1], 13, -1, 6, 14, -1, 7, 15, -1);
                    *(VU*)to.covars2d = __builtin_shufflevector(front, rows[2], 0, 1, 8, 3, 4, 9, 6, 7);
                    *(VU*)(to.covars2d + 8) = __builtin_shufflevector(middle, rows[2], 10, 1, 2, 11, 4, 5, 12, 7);
                    *(VU*)(to.covars2d + 16) = __builtin_shufflevector(back, rows[2], 0, 13, 2, 3, 14, 5, 6, 15);
                } else {
                    memset(to.means2d, 0, sizeof spare.means2d);
                    memset(to.covars2d, 0, sizeof spare.covars2d);
                    memset(to.conics, 0, sizeof spare.conics);
                    memset(to.radii, 0, sizeof spare.radii);
                    memset(to.centers, 0, sizeof spare.centers);
                    memset(to.whitenings, 0, sizeof spare.whitenings);
                    memset(to.boxes, 0, sizeof spare.boxes);
                }
                if (!whole) {
                    memcpy(means2d + 2 * at, to.means2d, 2 * count * sizeof(float));
                    memcpy(covars2d + 3 * at, to.covars2d, 3 * count * sizeof(double));
                    memcpy(depths + at, to.depths, count * sizeof(float));
                    memcpy(conics + 3 * at, to.conics, 3 * count * sizeof(float));
                    memcpy(radii + 2 * at, to.radii, 2 * count * sizeof(int));
                    memcpy(sort_depths + at, to.sort_depths, count * sizeof(double));
                    memcpy(centers + 4 * at, to.centers, 4 * count * sizeof(float));
                    memcpy(whitenings + 4 * at, to.whitenings, 4 * count * sizeof(float));
                    memcpy(boxes + 4 * at, to.boxes, 4 * count * sizeof(int));
                }
            }
        }
        if (__builtin_reduce_or(flaws)) __atomic_store_n(bad, 1ll, __ATOMIC_RELAXED);
    });
    free(cameras);
}
