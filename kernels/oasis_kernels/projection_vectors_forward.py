"""`projection.project` in float32 on the CPU; see `projection_vectors`."""

import functools
from typing import Any

import warp as wp

from oasis_kernels.projection_vectors import SCENE, block, snippet
from oasis_kernels.vectors import cpu_options

FIELDS = SCENE | {
    "opacities": "const float*",  # [n]
    "near": "double",
    "far": "double",
    "eps2d": "double",
    "radius_clip": "double",
    "alpha_min": "double",
    "extent_sigmas": "double",
    "limit": "double",  # magnitude above which a value is bad
    "means2d": "float*",  # [C, n, 2]
    "covars2d": "double*",  # [C, n, 3]
    "conics": "float*",  # [C, n, 3]
    "depths": "float*",  # [C, n]
    "sort_depths": "double*",  # [C, n]
    "radii": "int*",  # [C, n, 2]
    "centers": "float*",  # [C, n, 4]
    "whitenings": "float*",  # [C, n, 4]
    "boxes": "int*",  # [C, n, 4]
    "bad": "long long",  # out: not 0 where an input is not finite, beyond the limit or outside its range
}
ForwardBlock = block("ForwardBlock", FIELDS)

FORWARD = """
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
            const V v[3] = {is[0] ? s[0] : is[1] ? s[1] : s[2], is[0] ? s[1] : is[1] ? s[3] : s[4],
                            is[0] ? s[2] : is[1] ? s[4] : s[5]};
            const I some = d > 0.0;
            const V root = 1.0 / __builtin_elementwise_sqrt(some ? d : (V)(1.0));
            for (int row = 0; row < 3; row++) f[3 * row + column] = some ? v[row] * root : zero;
            int k = 0;
            for (int i = 0; i < 3; i++) for (int j = i; j < 3; j++, k++)
                s[k] = (is[i] | is[j] | ~some) ? zero : s[k] - f[3 * i + column] * f[3 * j + column];
        }
    };
    const F limit = (F)((float)p.limit);
    auto unsound = [&](F a) -> N { return ~(__builtin_elementwise_abs(a) <= limit); };
    N bad = (N)(0);
    for (long long c = 0; c < p.n_cameras; c++) {
        for (int k = 0; k < 16; k++) bad |= unsound((F)(p.viewmats[16 * c + k]));
        for (int k = 0; k < 9; k++) bad |= unsound((F)(p.Ks[9 * c + k]));
        if (p.Ks[9 * c] == 0.f || p.Ks[9 * c + 4] == 0.f) bad |= (N)(1);
    }

    struct Inputs { float means[24], quats[32], scales[24], covars[72], opacities[8]; } in;
    struct Outputs {
        double covars2d[24], sort_depths[8];
        float means2d[16], conics[24], depths[8], centers[32], whitenings[32];
        int radii[16], boxes[32];
    } out;
    const V reach_limit = (V)(p.extent_sigmas * p.extent_sigmas);
    const double inverse_alpha_min = 1.0 / p.alpha_min;

    for (long long i = first; i < end; i += 8) {
        const int count = end - i < 8 ? (int)(end - i) : 8;
        const float *means = p.means + 3 * i, *opacities = p.opacities + i;
        const float *quats = p.quats + 4 * i, *scales = p.scales + 3 * i, *covars = p.covars + 9 * i;
        if (count < 8) {  // fill the lanes behind the end with the last Gaussian
            auto fill = [&](float* to, const float*& from, int width) {
                for (int lane = 0; lane < 8; lane++)
                    memcpy(to + lane * width, from + wp::min(lane, count - 1) * width, width * sizeof(float));
                from = to;
            };
            fill(in.means, means, 3);
            fill(in.opacities, opacities, 1);
            if (p.covars) fill(in.covars, covars, 9);
            else fill(in.quats, quats, 4), fill(in.scales, scales, 3);
        }

        F a, b, c, d;
        V f[9];
        if (p.covars) {
            V s[6];
            load_covariance(covars, s);
            for (int k = 0; k < 9; k++) bad |= unsound(*(const FU*)(covars + 8 * k));
            bad |= (narrow(s[0]) < 0.f) | (narrow(s[3]) < 0.f) | (narrow(s[5]) < 0.f);
            factor(s, f);
        } else {
            load4(quats, a, b, c, d);
            bad |= unsound(a) | unsound(b) | unsound(c) | unsound(d);
            bad |= (a == 0.f) & (b == 0.f) & (c == 0.f) & (d == 0.f);
            rotation(wide(a), wide(b), wide(c), wide(d), f);
            load3(scales, a, b, c);
            bad |= unsound(a) | unsound(b) | unsound(c);
            const V scale[3] = {wide(a), wide(b), wide(c)};
            for (int k = 0; k < 9; k++) f[k] *= scale[k % 3];
        }
        load3(means, a, b, c);
        bad |= unsound(a) | unsound(b) | unsound(c);
        const V X = wide(a), Y = wide(b), Z = wide(c);
        a = *(const FU*)opacities;
        bad |= ~((a >= 0.f) & (a <= 1.f));
        const V opacity = wide(a);
        const I bright = opacity >= p.alpha_min;
        const V ratio = opacity * inverse_alpha_min;
        V reach = logarithm(ratio > 1.0 ? ratio : (V)(1.0));  // squared, in standard deviations
        reach = reach + reach < reach_limit ? reach + reach : reach_limit;

        for (long long camera = 0; camera < p.n_cameras; camera++) {
            const Camera& k = cameras[camera];
            const long long at = camera * p.n + i;
            const bool whole = count == 8;
            float* means2d = whole ? p.means2d + 2 * at : out.means2d;
            double* covars2d = whole ? p.covars2d + 3 * at : out.covars2d;
            float* conics = whole ? p.conics + 3 * at : out.conics;
            float* depths = whole ? p.depths + at : out.depths;
            double* sort_depths = whole ? p.sort_depths + at : out.sort_depths;
            int* radii = whole ? p.radii + 2 * at : out.radii;
            float* centers = whole ? p.centers + 4 * at : out.centers;
            float* whitenings = whole ? p.whitenings + 4 * at : out.whitenings;
            int* boxes = whole ? p.boxes + 4 * at : out.boxes;

            const V px = k.r[0] * X + k.r[1] * Y + k.r[2] * Z + k.t[0];
            const V py = k.r[3] * X + k.r[4] * Y + k.r[5] * Z + k.t[1];
            const V pz = k.r[6] * X + k.r[7] * Y + k.r[8] * Z + k.t[2];
            *(FU*)depths = narrow(pz);
            *(VU*)sort_depths = pz;
            // Comparisons are written so that a NaN, where the caller did not want to be checked, is not drawn.
            I drawn = (pz >= p.near) & (pz <= p.far) & bright;
            if (__builtin_reduce_or(drawn)) {
                const V inverse = 1.0 / (drawn ? pz : (V)(1.0)), u = px * inverse, v = py * inverse;
                const V slope_u = u < k.u_low ? (V)(k.u_low) : u > k.u_high ? (V)(k.u_high) : u;
                const V slope_v = v < k.v_low ? (V)(k.v_low) : v > k.v_high ? (V)(k.v_high) : v;
                V m0[3], m1[3];
                {
                    V b0[3], b1[3];
                    const V j0 = k.fx * inverse, j1 = k.fy * inverse;
                    for (int n = 0; n < 3; n++) {
                        b0[n] = j0 * (k.r[n] - slope_u * k.r[6 + n]);
                        b1[n] = j1 * (k.r[3 + n] - slope_v * k.r[6 + n]);
                    }
                    for (int n = 0; n < 3; n++) {
                        m0[n] = f[n] * b0[0] + f[3 + n] * b0[1] + f[6 + n] * b0[2];
                        m1[n] = f[n] * b1[0] + f[3 + n] * b1[1] + f[6 + n] * b1[2];
                    }
                }
                const V flat_xx = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2];
                const V flat_yy = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2];
                const V xy = m0[0] * m1[0] + m0[1] * m1[1] + m0[2] * m1[2];
                const V xx = flat_xx + p.eps2d, yy = flat_yy + p.eps2d;
                // Cauchy-Binet: a sum of terms >= 0, where xx yy - xy^2 cancels for needles.
                const V n0 = m0[1] * m1[2] - m0[2] * m1[1];
                const V n1 = m0[2] * m1[0] - m0[0] * m1[2];
                const V n2 = m0[0] * m1[1] - m0[1] * m1[0];
                const V det = n0 * n0 + n1 * n1 + n2 * n2 + p.eps2d * (flat_xx + flat_yy + p.eps2d);

                const V x = k.fx * u + k.cx, y = k.fy * v + k.cy;
                const V extent_x = __builtin_elementwise_sqrt(reach * xx);
                const V extent_y = __builtin_elementwise_sqrt(reach * yy);
                V radius_x = __builtin_elementwise_ceil(extent_x), radius_y = __builtin_elementwise_ceil(extent_y);
                radius_x = radius_x > 1.0 ? radius_x : (V)(1.0);
                radius_y = radius_y > 1.0 ? radius_y : (V)(1.0);
                drawn &= (det > 0.0) & ((radius_x > p.radius_clip) | (radius_y > p.radius_clip));
                drawn &= (x + radius_x > 0.0) & (x - radius_x < p.width);
                drawn &= (y + radius_y > 0.0) & (y - radius_y < p.height);

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
                const V slack_x = extent_x * (1.0 + @BOX_SLACK@) + @BOX_SLACK@;
                const V slack_y = extent_y * (1.0 + @BOX_SLACK@) + @BOX_SLACK@;
                store4((float*)boxes, whole_number(low(x, slack_x, p.width)), whole_number(low(y, slack_y, p.height)),
                       whole_number(high(x, slack_x, p.width)), whole_number(high(y, slack_y, p.height)));
                const V largest = (V)(2147483647.0);
                store2((float*)radii, whole_number(radius_x < largest ? radius_x : largest),
                       whole_number(radius_y < largest ? radius_y : largest));
                store2(means2d, narrow(kept(x)), narrow(kept(y)));
                const F whole_x = narrow(kept(__builtin_elementwise_floor(x)));
                const F whole_y = narrow(kept(__builtin_elementwise_floor(y)));
                store4(centers, whole_x, whole_y, narrow(kept(x) - wide(whole_x)), narrow(kept(y) - wide(whole_y)));

                const V sound = drawn ? det : (V)(1.0), inverse_det = 1.0 / sound;
                store3(conics, narrow(kept(yy * inverse_det)), narrow(kept(-xy * inverse_det)),
                       narrow(kept(xx * inverse_det)));
                // Cholesky factor of the inverse, pivoted on the larger diagonal.
                const I across = xx >= yy;
                const V pivot = drawn ? (across ? xx : yy) : (V)(1.0);
                const V h = 1.0 / __builtin_elementwise_sqrt(pivot);
                const V tall = __builtin_elementwise_sqrt(pivot * inverse_det), sheared = -tall * xy * (h * h);
                store4(whitenings, narrow(kept(across ? h : (V)(0.0))), narrow(kept(across ? (V)(0.0) : h)),
                       narrow(kept(across ? sheared : tall)), narrow(kept(across ? tall : sheared)));
                const V rows[3] = {kept(xx), kept(xy), kept(yy)};
                const V front = __builtin_shufflevector(rows[0], rows[1], 0, 8, -1, 1, 9, -1, 2, 10);
                const V middle = __builtin_shufflevector(rows[0], rows[1], -1, 3, 11, -1, 4, 12, -1, 5);
                const V back = __builtin_shufflevector(rows[0], rows[1], 13, -1, 6, 14, -1, 7, 15, -1);
                *(VU*)covars2d = __builtin_shufflevector(front, rows[2], 0, 1, 8, 3, 4, 9, 6, 7);
                *(VU*)(covars2d + 8) = __builtin_shufflevector(middle, rows[2], 10, 1, 2, 11, 4, 5, 12, 7);
                *(VU*)(covars2d + 16) = __builtin_shufflevector(back, rows[2], 0, 13, 2, 3, 14, 5, 6, 15);
            } else {
                memset(means2d, 0, sizeof out.means2d);
                memset(covars2d, 0, sizeof out.covars2d);
                memset(conics, 0, sizeof out.conics);
                memset(radii, 0, sizeof out.radii);
                memset(centers, 0, sizeof out.centers);
                memset(whitenings, 0, sizeof out.whitenings);
                memset(boxes, 0, sizeof out.boxes);
            }
            if (!whole) {
                memcpy(p.means2d + 2 * at, means2d, 2 * count * sizeof(float));
                memcpy(p.covars2d + 3 * at, covars2d, 3 * count * sizeof(double));
                memcpy(p.conics + 3 * at, conics, 3 * count * sizeof(float));
                memcpy(p.depths + at, depths, count * sizeof(float));
                memcpy(p.sort_depths + at, sort_depths, count * sizeof(double));
                memcpy(p.radii + 2 * at, radii, 2 * count * sizeof(int));
                memcpy(p.centers + 4 * at, centers, 4 * count * sizeof(float));
                memcpy(p.whitenings + 4 * at, whitenings, 4 * count * sizeof(float));
                memcpy(p.boxes + 4 * at, boxes, 4 * count * sizeof(int));
            }
        }
    }
    if (__builtin_reduce_or(bad)) __atomic_fetch_or(&p.bad, 1ll, __ATOMIC_RELAXED);
    free(cameras);
"""


@functools.cache
def project() -> Any:
    """Kernel: one thread a chunk; `params` is the address of a `ForwardBlock`."""

    @wp.func_native(snippet(FIELDS, FORWARD))
    def project_chunk(chunk: int, params: wp.uint64): ...

    @wp.kernel(enable_backward=False, module="unique", module_options=cpu_options())
    def project_vectors(first: int, params: wp.uint64):
        project_chunk(first + wp.tid(), params)

    return project_vectors
