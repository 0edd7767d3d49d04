"""Float32 projection on the CPU: `projection.project` and `project_backward`, eight Gaussians at once.

One thread a chunk of `CHUNK` Gaussians, through all cameras. Arithmetic is float64 as in the generic kernels, eight
lanes a vector, so that the two agree to the rounding of the stored float32. Arrays are raw pointers in one parameter
block, whose sizes the operator has proved. A block of fewer than eight Gaussians at the end of the arrays is copied to
and from buffers of eight on the stack: nothing outside the arrays is read or written, and the same instructions compute
every Gaussian, wherever it stands.

Both passes use factors: covariance = F F^T with F = R(q) S, or F the Cholesky factor of a given covariance. With B the
2 x 3 matrix J R_camera and M = B F, the covariance in the image is M M^T + eps2d (Zwicker et al. 2001, eq. 31). The
adjoint is B^T G B by the covariance and 2 G B covariance by B, where G is the symmetric gradient in the image.
"""

import ctypes
import functools
from typing import Any

import warp as wp

from oasis_kernels import constants
from oasis_kernels.vectors import cpu_options

CHUNK = 512
"""Gaussians a task, a multiple of 8; camera gradients are summed by chunks, so that threads do not change them."""

_GAUSSIANS = {
    "n": "long long",
    "n_cameras": "long long",
    "means": "const float*",  # [n, 3]
    "quats": "const float*",  # [n, 4], or null where covars is given
    "scales": "const float*",  # [n, 3], or null
    "covars": "const float*",  # [n, 3, 3], or null; read as its symmetric part
    "viewmats": "const float*",  # [C, 4, 4]
    "Ks": "const float*",  # [C, 3, 3]
    "width": "double",
    "height": "double",
}
_FORWARD = _GAUSSIANS | {
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
_BACKWARD = _GAUSSIANS | {
    "radii": "const int*",  # [C, n, 2]; 0 where nothing was drawn
    "g_means2d": "const float*",  # [C, n, 2], or null for zeros, as the next two
    "g_covars2d": "const double*",  # [C, n, 3]
    "g_depths": "const float*",  # [C, n]
    "g_means": "float*",  # [n, 3], or null where nobody asks, as all that follow
    "g_quats": "float*",  # [n, 4]
    "g_scales": "float*",  # [n, 3]
    "g_covars": "float*",  # [n, 3, 3]
    "g_cameras": "double*",  # [C, chunks, 12]: by the upper three rows of viewmats, summed over the chunk
}


def _structure(name: str, fields: dict[str, str]) -> type[ctypes.Structure]:
    """The parameter block as Python fills it; every field has eight bytes."""
    kinds = {"double": ctypes.c_double, "long long": ctypes.c_longlong}
    return type(name, (ctypes.Structure,), {"_fields_": [(f, kinds.get(t, ctypes.c_void_p)) for f, t in fields.items()]})


ForwardBlock = _structure("ForwardBlock", _FORWARD)
BackwardBlock = _structure("BackwardBlock", _BACKWARD)


def _struct(fields: dict[str, str]) -> str:
    """The same block in C++, named P."""
    return "struct P { " + " ".join(f"{kind} {name};" for name, kind in fields.items()) + " };"


HEAD = """
    #pragma clang fp contract(fast)
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
        *(FU16*)p =
            __builtin_shufflevector(xy, zz, 0, 8, 16, 1, 9, 17, 2, 10, 18, 3, 11, 19, 4, 12, 20, 5);
        *(FU*)(p + 16) = __builtin_shufflevector(xy, zz, 13, 21, 6, 14, 22, 7, 15, 23);
    };
    auto store4 = [&](float* p, F x, F y, F z, F w) {
        const F16 xy = join(x, y), zw = join(z, w);
        *(FU16*)p = __builtin_shufflevector(xy, zw, 0, 8, 16, 24, 1, 9, 17, 25, 2, 10, 18, 26, 3, 11, 19, 27);
        *(FU16*)(p + 16) =
            __builtin_shufflevector(xy, zw, 4, 12, 20, 28, 5, 13, 21, 29, 6, 14, 22, 30, 7, 15, 23, 31);
    };

    struct Camera {
        double r[9], t[3], fx, fy, cx, cy, u_low, u_high, v_low, v_high;  // r by rows; limits of x/z and y/z in J
    };
    auto camera_at = [](const P& p, long long c) -> Camera {
        const float *view = p.viewmats + 16 * c, *K = p.Ks + 9 * c;
        Camera out;
        for (int row = 0; row < 3; row++) {
            for (int column = 0; column < 3; column++) out.r[3 * row + column] = view[4 * row + column];
            out.t[row] = view[4 * row + 3];
        }
        out.fx = K[0];
        out.fy = K[4];
        out.cx = K[2];
        out.cy = K[5];
        const double margin_x = @JACOBIAN_LIMIT@ * 0.5 * p.width / out.fx;
        const double margin_y = @JACOBIAN_LIMIT@ * 0.5 * p.height / out.fy;
        out.u_low = -(out.cx / out.fx) - margin_x;
        out.u_high = (p.width - out.cx) / out.fx + margin_x;
        out.v_low = -(out.cy / out.fy) - margin_y;
        out.v_high = (p.height - out.cy) / out.fy + margin_y;
        return out;
    };

    // Rotation matrix by rows of quaternions of any norm but 0; 1 / |q|^2. Squares of float32 fit in float64.
    auto rotation = [](V w, V x, V y, V z, V* r) -> V {
        const V inverse = 1.0 / (w * w + x * x + y * y + z * z), two = inverse + inverse;
        r[0] = 1.0 - two * (y * y + z * z);
        r[1] = two * (x * y - w * z);
        r[2] = two * (x * z + w * y);
        r[3] = two * (x * y + w * z);
        r[4] = 1.0 - two * (x * x + z * z);
        r[5] = two * (y * z - w * x);
        r[6] = two * (x * z - w * y);
        r[7] = two * (y * z + w * x);
        r[8] = 1.0 - two * (x * x + y * y);
        return inverse;
    };
    // Symmetric part of eight 3 x 3 matrices: xx, xy, xz, yy, yz, zz.
    auto load_covariance = [](const float* p, V* s) {
        const int pair[6][2] = {{0, 0}, {1, 3}, {2, 6}, {4, 4}, {5, 7}, {8, 8}};
        for (int k = 0; k < 6; k++) for (int lane = 0; lane < 8; lane++)
            s[k][lane] = 0.5 * ((double)p[9 * lane + pair[k][0]] + (double)p[9 * lane + pair[k][1]]);
    };

    P& p = *(P*)params;
    const long long first = (long long)chunk * @CHUNK@, end = first + @CHUNK@ < p.n ? first + @CHUNK@ : p.n;
    Camera* cameras = (Camera*)malloc(p.n_cameras * sizeof(Camera));
    for (long long c = 0; c < p.n_cameras; c++) cameras[c] = camera_at(p, c);
"""

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

BACKWARD = """
    struct Inputs {
        double g_covars2d[24];
        float means[24], quats[32], scales[24], covars[72], g_means2d[16], g_depths[8];
        int radii[16];
    } in;
    struct Outputs { float means[24], quats[32], scales[24], covars[72]; } out;
    const bool of_shape = p.g_quats || p.g_scales || p.g_covars, of_place = p.g_means || p.g_cameras;
    double* sums = 0;  // by camera and matrix entry, one a lane
    if (p.g_cameras) {
        sums = (double*)malloc(p.n_cameras * 96 * sizeof(double));
        memset(sums, 0, p.n_cameras * 96 * sizeof(double));
    }

    for (long long i = first; i < end; i += 8) {
        const int count = end - i < 8 ? (int)(end - i) : 8;
        const bool whole = count == 8;
        const float *means = p.means + 3 * i, *quats = p.quats + 4 * i, *scales = p.scales + 3 * i;
        const float* covars = p.covars + 9 * i;
        if (!whole) {  // lanes behind the end stay 0: nothing was drawn there
            memset(&in, 0, sizeof in);
            memcpy(in.means, means, 3 * count * sizeof(float));
            means = in.means;
            if (p.covars) {
                memcpy(in.covars, covars, 9 * count * sizeof(float));
                covars = in.covars;
            } else {
                memcpy(in.quats, quats, 4 * count * sizeof(float));
                memcpy(in.scales, scales, 3 * count * sizeof(float));
                quats = in.quats;
                scales = in.scales;
            }
        }
        F a, b, c, d;
        load3(means, a, b, c);
        const V mean[3] = {wide(a), wide(b), wide(c)};
        V w, x, y, z, inverse_norm, r[9], scale[3], s[6];  // s: covariance xx, xy, xz, yy, yz, zz
        bool loaded = false;
        I touched = (I)(0);
        V g_mean[3] = {}, g_s[6] = {};

        for (long long camera = 0; camera < p.n_cameras; camera++) {
            const Camera& k = cameras[camera];
            const long long at = camera * p.n + i;
            const int* radii = p.radii + 2 * at;
            const float *g_means2d = p.g_means2d + 2 * at, *g_depths = p.g_depths + at;
            const double* g_covars2d = p.g_covars2d + 3 * at;
            if (!whole) {
                radii = (const int*)memcpy(in.radii, radii, 2 * count * sizeof(int));
                if (p.g_means2d) g_means2d = (const float*)memcpy(in.g_means2d, g_means2d, 2 * count * sizeof(float));
                if (p.g_depths) g_depths = (const float*)memcpy(in.g_depths, g_depths, count * sizeof(float));
                if (p.g_covars2d)
                    g_covars2d = (const double*)memcpy(in.g_covars2d, g_covars2d, 3 * count * sizeof(double));
            }
            V g_x = (V)(0.0), g_y = g_x, g_depth = g_x, g_xx = g_x, g_xy = g_x, g_yy = g_x;
            load2((const float*)radii, a, b);
            I active = __builtin_convertvector(__builtin_bit_cast(N, a) != 0, I);
            if (p.g_means2d) {
                load2(g_means2d, a, b);
                g_x = wide(a);
                g_y = wide(b);
            }
            if (p.g_covars2d) {
                const V front = *(const VU*)g_covars2d, middle = *(const VU*)(g_covars2d + 8);
                const V back = *(const VU*)(g_covars2d + 16);
                const V xs = __builtin_shufflevector(front, middle, 0, 3, 6, 9, 12, 15, -1, -1);
                const V xys = __builtin_shufflevector(front, middle, 1, 4, 7, 10, 13, -1, -1, -1);
                const V ys = __builtin_shufflevector(front, middle, 2, 5, 8, 11, 14, -1, -1, -1);
                g_xx = __builtin_shufflevector(xs, back, 0, 1, 2, 3, 4, 5, 10, 13);
                g_xy = __builtin_shufflevector(xys, back, 0, 1, 2, 3, 4, 8, 11, 14);
                g_yy = __builtin_shufflevector(ys, back, 0, 1, 2, 3, 4, 9, 12, 15);
            }
            if (p.g_depths) g_depth = wide(*(const FU*)g_depths);
            active &= (g_x != 0.0) | (g_y != 0.0) | (g_xx != 0.0) | (g_xy != 0.0) | (g_yy != 0.0);
            V g_point[3] = {(V)(0.0), (V)(0.0), g_depth};

            if (__builtin_reduce_or(active)) {
                if (!loaded) {
                    loaded = true;
                    if (p.covars) load_covariance(covars, s);
                    else {
                        load4(quats, a, b, c, d);
                        w = wide(a);
                        x = wide(b);
                        y = wide(c);
                        z = wide(d);
                        inverse_norm = rotation(w, x, y, z, r);
                        load3(scales, a, b, c);
                        scale[0] = wide(a);
                        scale[1] = wide(b);
                        scale[2] = wide(c);
                        V f[9];
                        for (int n = 0; n < 9; n++) f[n] = r[n] * scale[n % 3];
                        int n = 0;
                        for (int row = 0; row < 3; row++) for (int other = row; other < 3; other++, n++)
                            s[n] = f[3 * row] * f[3 * other] + f[3 * row + 1] * f[3 * other + 1]
                                + f[3 * row + 2] * f[3 * other + 2];
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
                const V inverse = 1.0 / (active ? pz : (V)(1.0)), u = px * inverse, v = py * inverse;
                const V slope_u = u < k.u_low ? (V)(k.u_low) : u > k.u_high ? (V)(k.u_high) : u;
                const V slope_v = v < k.v_low ? (V)(k.v_low) : v > k.v_high ? (V)(k.v_high) : v;
                const V j0 = k.fx * inverse, j1 = k.fy * inverse;
                V b0[3], b1[3], g_b0[3], g_b1[3];
                for (int n = 0; n < 3; n++) {
                    b0[n] = j0 * (k.r[n] - slope_u * k.r[6 + n]);
                    b1[n] = j1 * (k.r[3 + n] - slope_v * k.r[6 + n]);
                    g_b0[n] = g_xx * b0[n] + g_xy * b1[n];  // rows of G B, below times 2 covariance
                    g_b1[n] = g_xy * b0[n] + g_yy * b1[n];
                }
                if (of_shape) {
                    int n = 0;
                    for (int row = 0; row < 3; row++) for (int column = row; column < 3; column++, n++)
                        g_s[n] += b0[row] * g_b0[column] + b1[row] * g_b1[column];
                }
                if (of_place) {
                    auto spread = [&](V* g) {
                        const V g0 = g[0] + g[0], g1 = g[1] + g[1], g2 = g[2] + g[2];
                        g[0] = s[0] * g0 + s[1] * g1 + s[2] * g2;
                        g[1] = s[1] * g0 + s[3] * g1 + s[4] * g2;
                        g[2] = s[2] * g0 + s[4] * g1 + s[5] * g2;
                    };
                    spread(g_b0);
                    spread(g_b1);
                    // J depends on the point by 1/z and its slopes, which stand still where they were clamped.
                    const V g_j00 = k.r[0] * g_b0[0] + k.r[1] * g_b0[1] + k.r[2] * g_b0[2];
                    const V g_j02 = k.r[6] * g_b0[0] + k.r[7] * g_b0[1] + k.r[8] * g_b0[2];
                    const V g_j11 = k.r[3] * g_b1[0] + k.r[4] * g_b1[1] + k.r[5] * g_b1[2];
                    const V g_j12 = k.r[6] * g_b1[0] + k.r[7] * g_b1[1] + k.r[8] * g_b1[2];
                    const V g_u = k.fx * g_x - (slope_u == u ? j0 * g_j02 : (V)(0.0));
                    const V g_v = k.fy * g_y - (slope_v == v ? j1 * g_j12 : (V)(0.0));
                    const V g_inverse = k.fx * (g_j00 - slope_u * g_j02) + k.fy * (g_j11 - slope_v * g_j12);
                    g_point[0] = kept(inverse * g_u);
                    g_point[1] = kept(inverse * g_v);
                    g_point[2] -= kept(inverse * (g_u * u + g_v * v + inverse * g_inverse));
                    if (sums) for (int column = 0; column < 3; column++) {
                        VU* to = (VU*)(sums + camera * 96) + column;
                        const V first_row = j0 * g_b0[column], second_row = j1 * g_b1[column];
                        to[0] += kept(first_row);
                        to[4] += kept(second_row);
                        to[8] -= kept(slope_u * first_row + slope_v * second_row);
                    }
                }
            }
            if (sums) for (int row = 0; row < 3; row++) {
                VU* to = (VU*)(sums + camera * 96) + 4 * row;
                const V g = g_point[row];
                for (int column = 0; column < 3; column++) to[column] += g != 0.0 ? g * mean[column] : (V)(0.0);
                to[3] += g;
            }
            for (int n = 0; n < 3; n++)
                g_mean[n] += k.r[n] * g_point[0] + k.r[3 + n] * g_point[1] + k.r[6 + n] * g_point[2];
        }

        if (p.g_means) {
            float* to = whole ? p.g_means + 3 * i : out.means;
            store3(to, narrow(g_mean[0]), narrow(g_mean[1]), narrow(g_mean[2]));
            if (!whole) memcpy(p.g_means + 3 * i, to, 3 * count * sizeof(float));
        }
        if (!loaded) {
            if (p.g_quats) memset(p.g_quats + 4 * i, 0, 4 * count * sizeof(float));
            if (p.g_scales) memset(p.g_scales + 3 * i, 0, 3 * count * sizeof(float));
            if (p.g_covars) memset(p.g_covars + 9 * i, 0, 9 * count * sizeof(float));
            continue;
        }
        auto kept = [&](V value) -> F { return narrow(touched ? value : (V)(0.0)); };
        const V g[9] = {g_s[0], g_s[1], g_s[2], g_s[1], g_s[3], g_s[4], g_s[2], g_s[4], g_s[5]};
        if (p.g_covars) {
            float* to = whole ? p.g_covars + 9 * i : out.covars;
            for (int n = 0; n < 9; n++) {
                const F entry = kept(g[n]);
                for (int lane = 0; lane < 8; lane++) to[9 * lane + n] = entry[lane];
            }
            if (!whole) memcpy(p.g_covars + 9 * i, to, 9 * count * sizeof(float));
        }
        if (p.g_quats || p.g_scales) {
            V h[9], g_scale[3];  // h = 2 g R: by F = R S it is h S, by R itself h S S
            for (int row = 0; row < 3; row++) for (int column = 0; column < 3; column++) {
                const V half = g[3 * row] * r[column] + g[3 * row + 1] * r[3 + column] + g[3 * row + 2] * r[6 + column];
                h[3 * row + column] = half + half;
            }
            for (int n = 0; n < 3; n++) {
                g_scale[n] = scale[n] * (r[n] * h[n] + r[3 + n] * h[3 + n] + r[6 + n] * h[6 + n]);
                const V square = scale[n] * scale[n];
                for (int row = 0; row < 3; row++) h[3 * row + n] *= square;
            }
            if (p.g_scales) {
                float* to = whole ? p.g_scales + 3 * i : out.scales;
                store3(to, kept(g_scale[0]), kept(g_scale[1]), kept(g_scale[2]));
                if (!whole) memcpy(p.g_scales + 3 * i, to, 3 * count * sizeof(float));
            }
            if (p.g_quats) {
                const V ax = h[7] - h[5], ay = h[2] - h[6], az = h[3] - h[1];
                const V sx = h[5] + h[7], sy = h[2] + h[6], sz = h[1] + h[3];
                const V g_w = x * ax + y * ay + z * az;
                const V g_x = w * ax + y * sz + z * sy - 2.0 * x * (h[4] + h[8]);
                const V g_y = w * ay + x * sz + z * sx - 2.0 * y * (h[0] + h[8]);
                const V g_z = w * az + x * sy + y * sx - 2.0 * z * (h[0] + h[4]);
                const V along = inverse_norm * (g_w * w + g_x * x + g_y * y + g_z * z), two = inverse_norm * 2.0;
                float* to = whole ? p.g_quats + 4 * i : out.quats;
                store4(to, kept(two * (g_w - along * w)), kept(two * (g_x - along * x)),
                       kept(two * (g_y - along * y)), kept(two * (g_z - along * z)));
                if (!whole) memcpy(p.g_quats + 4 * i, to, 4 * count * sizeof(float));
            }
        }
    }
    if (sums) {
        const long long n_chunks = (p.n + @CHUNK@ - 1) / @CHUNK@;
        for (long long c = 0; c < p.n_cameras; c++) for (int n = 0; n < 12; n++) {
            double total = 0.0;
            for (int lane = 0; lane < 8; lane++) total += sums[c * 96 + n * 8 + lane];
            p.g_cameras[(c * n_chunks + chunk) * 12 + n] = total;
        }
        free(sums);
    }
    free(cameras);
"""


def _snippet(fields: dict[str, str], body: str) -> str:
    """C++ of one chunk, with the constants written in."""
    text = HEAD.replace("    struct Camera", f"    {_struct(fields)}\n    struct Camera", 1) + body
    for name, value in {
        "CHUNK": CHUNK,
        "JACOBIAN_LIMIT": constants.JACOBIAN_LIMIT,
        "BOX_SLACK": constants.BOX_SLACK,
    }.items():
        text = text.replace(f"@{name}@", repr(value))
    return text


@functools.cache
def project() -> Any:
    """Kernel: `projection.project` of one chunk a thread; `params` is the address of a `ForwardBlock`."""

    @wp.func_native(_snippet(_FORWARD, FORWARD))
    def project_chunk(chunk: int, params: wp.uint64): ...

    @wp.kernel(enable_backward=False, module="unique", module_options=cpu_options())
    def project_vectors(first: int, params: wp.uint64):
        project_chunk(first + wp.tid(), params)

    return project_vectors


@functools.cache
def project_backward() -> Any:
    """Kernel: `projection.project_backward` of one chunk a thread; `params` is the address of a `BackwardBlock`."""

    @wp.func_native(_snippet(_BACKWARD, BACKWARD))
    def project_chunk_backward(chunk: int, params: wp.uint64): ...

    @wp.kernel(enable_backward=False, module="unique", module_options=cpu_options())
    def project_vectors_backward(first: int, params: wp.uint64):
        project_chunk_backward(first + wp.tid(), params)

    return project_vectors_backward
