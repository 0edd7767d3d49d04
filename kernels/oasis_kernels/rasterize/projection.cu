// `projection.project` in float32 on CUDA: one thread per (camera, Gaussian).
//
// Arithmetic is float64 as in the generic kernels, of which a float32 GPU for training does half as much a second; what
// takes time is the latency of its divisions and roots, so that they start from the hardware's approximations.

__global__ void project(
    int n,
    int n_cameras,
#include "gaussian_parameters.inc"
    int ortho,               // 1: x = fx X + cx, y = fy Y + cy, whatever the depth
    const float* opacities,  // [n]
    double near,
    double far,
    double radius_clip,
    double eps2d,
    double alpha_min,
    double extent_sigmas,
    float largest,        // magnitude of a sound input
    float2* means2d,      // [C, n]
    double* covars2d,     // [C, n, 3]
    float* depths,        // [C, n]
    float* conics,        // [C, n, 3]
    int2* radii,          // [C, n]
    double* sort_depths,  // [C, n]
    float4* centers,      // [C, n]
    float4* whitenings,   // [C, n]
    int4* boxes,          // [C, n]
    int* counters,        // of the tiles, to be cleared
    int n_counters,
    int n_threads,
    long long* bad,       // made 1 where an input is not finite, too large or outside its range; or null
    const float* colors,  // [n_colors], only to be checked; or null, as the next
    long long n_colors,
    const float* backgrounds,  // [n_backgrounds]
    long long n_backgrounds
) {
#include "projection_cuda.h"
    for (int k = thread; k < n_counters; k += n_threads) counters[k] = 0;
    if (bad) {
        bool odd = false;
        for (long long k = thread; k < n_colors; k += n_threads) odd |= !(fabsf(colors[k]) <= largest);
        for (long long k = thread; k < n_backgrounds; k += n_threads) odd |= !(fabsf(backgrounds[k]) <= largest);
        if (odd) *bad = 1;
    }
    if (thread >= n * n_cameras) return;
    const int c = n_cameras == 1 ? 0 : thread / n, i = thread - c * n;
    bool flaw = false;
    auto sound = [&](float a) -> float {
        flaw |= !(fabsf(a) <= largest);
        return a;
    };
    if (bad && i == 0) {
        for (int k = 0; k < 16; k++) sound(viewmats[16 * c + k]);
        for (int k = 0; k < 9; k++) sound(Ks[9 * c + k]);
        flaw |= Ks[9 * c] == 0.f || Ks[9 * c + 4] == 0.f;
    }
    const double X = sound(means[3 * i]), Y = sound(means[3 * i + 1]), Z = sound(means[3 * i + 2]);
    const float own_opacity = opacities[i];
    flaw |= !(own_opacity >= 0.f && own_opacity <= 1.f);
    const double opacity = own_opacity;
    const Camera k = camera_at(c);
    const double pz = k.r[6] * X + k.r[7] * Y + k.r[8] * Z + k.t[2];

    double f[9];  // the covariance is F F^T
    if (covars) {
        double s[6];
        for (int e = 0; e < 9; e++) sound(covars[9 * i + e]);
        load_covariance(i, s);
        flaw |= s[0] < 0.0 || s[3] < 0.0 || s[5] < 0.0;
        // Columns by Cholesky with the largest diagonal first, which bears matrices without full rank and those that
        // rounding has made indefinite.
        for (int column = 0; column < 3; column++) {
            const bool second = s[3] > s[0], third = s[5] > (second ? s[3] : s[0]);
            const double d = third ? s[5] : second ? s[3] : s[0];
            const bool some = d > 0.0;
            const double root = inverse_root(some ? d : 1.0);
            const double v0 = third ? s[2] : second ? s[1] : s[0], v1 = third ? s[4] : second ? s[3] : s[1];
            const double v2 = third ? s[5] : second ? s[4] : s[2];
            f[column] = some ? v0 * root : 0.0;
            f[3 + column] = some ? v1 * root : 0.0;
            f[6 + column] = some ? v2 * root : 0.0;
            const bool gone[3] = {!third && !second, second && !third, third};
            int e = 0;
            for (int row = 0; row < 3; row++)
                for (int other = row; other < 3; other++, e++)
                    s[e] = gone[row] || gone[other] || !some ? 0.0 : s[e] - f[3 * row + column] * f[3 * other + column];
        }
    } else {
        const float4 q = {
            sound(quats[4 * i]), sound(quats[4 * i + 1]), sound(quats[4 * i + 2]), sound(quats[4 * i + 3])
        };
        flaw |= q.x == 0.f && q.y == 0.f && q.z == 0.f && q.w == 0.f;
        rotation(q.x, q.y, q.z, q.w, f);
        const double scale[3] = {sound(scales[3 * i]), sound(scales[3 * i + 1]), sound(scales[3 * i + 2])};
        for (int e = 0; e < 9; e++) f[e] *= scale[e % 3];
    }
    if (flaw && bad) *bad = 1;

    depths[thread] = (float)pz;
    sort_depths[thread] = pz;
    // Comparisons are written so that a NaN, where the caller did not want to be checked, is not drawn.
    bool drawn = pz >= near && pz <= far && opacity >= alpha_min;
    double x = 0.0, y = 0.0, xx = 0.0, xy = 0.0, yy = 0.0, det = 1.0, reach = 0.0;
    if (drawn) {
        const double inverse = ortho ? 1.0 : reciprocal(pz);
        const double u = (k.r[0] * X + k.r[1] * Y + k.r[2] * Z + k.t[0]) * inverse;
        const double v = (k.r[3] * X + k.r[4] * Y + k.r[5] * Z + k.t[1]) * inverse;
        double slope_u, slope_v, j0, j1, b0[3], b1[3];
#include "jacobian.h"
#include "covariance2d.h"
        x = k.fx * u + k.cx;
        y = k.fy * v + k.cy;
        reach = 2.0 * log(opacity / alpha_min);  // squared, in standard deviations
        reach = fmax(fmin(reach, extent_sigmas * extent_sigmas), 0.0);
        drawn = det > 0.0;
    }
    auto root = [&](double a) -> double { return a > 0.0 ? a * inverse_root(a) : 0.0; };
    const double extent_x = root(reach * xx), extent_y = root(reach * yy);
    const double radius_x = fmax(ceil(extent_x), 1.0), radius_y = fmax(ceil(extent_y), 1.0);
    drawn = drawn && (radius_x > radius_clip || radius_y > radius_clip) && x + radius_x > 0.0 && x - radius_x < width &&
            y + radius_y > 0.0 && y - radius_y < height;
    if (!drawn) {
        means2d[thread] = {0.f, 0.f};
        for (int e = 0; e < 3; e++) covars2d[3 * (long long)thread + e] = 0.0;
        for (int e = 0; e < 3; e++) conics[3 * (long long)thread + e] = 0.f;
        radii[thread] = {0, 0};
        centers[thread] = whitenings[thread] = {0.f, 0.f, 0.f, 0.f};
        boxes[thread] = {0, 0, 0, 0};
        return;
    }
    // First and past-the-last pixel whose centre is within the extent, clamped before it is an integer.
    auto low = [](double at, double extent, double size) -> int {
        return (int)fmin(fmax(ceil(at - extent - 0.5), 0.0), size);
    };
    auto high = [](double at, double extent, double size) -> int {
        return (int)fmin(fmax(floor(at + extent + 0.5), 0.0), size);
    };
    const double slack_x = extent_x * (1.0 + BOX_SLACK) + BOX_SLACK;
    const double slack_y = extent_y * (1.0 + BOX_SLACK) + BOX_SLACK;
    boxes[thread] = {
        low(x, slack_x, width), low(y, slack_y, height), high(x, slack_x, width), high(y, slack_y, height)
    };
    radii[thread] = {(int)fmin(radius_x, 2147483647.0), (int)fmin(radius_y, 2147483647.0)};
    means2d[thread] = {(float)x, (float)y};
    const float whole_x = (float)floor(x), whole_y = (float)floor(y);
    centers[thread] = {whole_x, whole_y, (float)(x - (double)whole_x), (float)(y - (double)whole_y)};
    const double inverse_det = reciprocal(det);
    float* conic = conics + 3 * (long long)thread;
    conic[0] = (float)(yy * inverse_det);
    conic[1] = (float)(-xy * inverse_det);
    conic[2] = (float)(xx * inverse_det);
    // Cholesky factor of the inverse, pivoted on the larger diagonal.
    const bool across = xx >= yy;
    const double pivot = across ? xx : yy, h = inverse_root(pivot);
    const double tall = root(pivot * inverse_det), sheared = -tall * xy * (h * h);
    whitenings[thread] = {
        across ? (float)h : 0.f, across ? 0.f : (float)h, (float)(across ? sheared : tall),
        (float)(across ? tall : sheared)
    };
    double* covariance = covars2d + 3 * (long long)thread;
    covariance[0] = xx;
    covariance[1] = xy;
    covariance[2] = yy;
}
