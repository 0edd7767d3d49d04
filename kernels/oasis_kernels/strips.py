"""Float32 rasterization on the CPU: what binning, drawing and its adjoint share.

The image is cut into strips, `strip_width` x `strip_height` pixels (an even number of rows); a pair is one
(Gaussian, strip). A strip has planes (transmittance, one a channel, ...) whose pixels lie in vectors of 16: 8 columns
of 2 neighbouring rows, pixel (x, y) in lane 2 x + y % 2 of its two rows. A vector may begin at any column: splats are
about as wide as a vector, and fixed blocks of columns would cut most of them in two. What a vector reads or writes past
the last column lies in `PAD` more columns, past the last row in the odd one; these pixels count as ended.

A drawn Gaussian is one record of 16 words, a cache line:

    0  whole x, whole y of its centre     4  W, by rows, scaled so that alpha = 2^(lo - |W d|^2)
    2  0.5 - remainder x, y               8  lo = log2(opacity)
                                          9  colours, where there are at most 3
                                         12  box x0, y0, x1, y1 (past the end), integers

Strips, tasks and records never depend on the number of threads, nor on whether a gradient will be asked for.
"""

import math

from oasis_kernels.constants import ALPHA_MAX, Rules

RECORD = 16
"""Words of a record."""
PAD = 8
"""Columns of a strip's planes past its last."""
RECORD_CHANNELS = 3
"""Colours that fit in a record; more are read from their tensor."""
CHUNK = 2048
"""Gaussians a task, at least."""
MAX_CHUNKS = 64
"""Tasks that Gaussians are shared out to, at most: their counts are a table of tasks times strips."""

EXP2 = {
    3: (0.9999280705, 0.6932609868, 0.242611174, 0.05517168985),
    4: (0.9999992614, 0.6931218145, 0.2402474485, 0.0559178621, 0.009570101652),
    5: (1.000000072, 0.6931469671, 0.2402211972, 0.05550713276, 0.00967554154, 0.001327647174),
}
"""Coefficients of 2^f on |f| <= 0.5, constant term first: relative minimax."""

VECTORS = """
    typedef float V __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    typedef float VU __attribute__((ext_vector_type(16), aligned(4)));
    typedef int IU __attribute__((ext_vector_type(16), aligned(4)));
    auto load = [](const float* p) -> V { return *(const VU*)p; };
    auto store = [](float* p, V v) { *(VU*)p = v; };
    auto fma = [](V a, V b, V c) -> V {
    #if defined(__FMA__) || defined(__aarch64__)
        return __builtin_elementwise_fma(a, b, c);
    #else
        return a * b + c;  // or the C library would be called for every lane
    #endif
    };
    const V column = {0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7};
    const V row = {0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1};
    // 2^x for -126 < x < 128, garbage elsewhere: adding 1.5 * 2^23 rounds x, and leaves the whole number in the low
    // bits, from where it is added to the exponent.
    auto exp2 = [&](V x) -> V {
        const V whole = x + 12582912.f;
        const V f = x - (whole - 12582912.f);
        const V r = @POLYNOMIAL@;
        return __builtin_bit_cast(V, __builtin_bit_cast(I, r) + (__builtin_bit_cast(I, whole) << 23));
    };
"""
"""C++: vectors of 16 floats, fused multiply-add where the CPU has it, and 2^x."""

LAYER = """
    // One Gaussian over one strip: `vectors` walks the pixels of its box, `exponent` is log2(alpha) before the cap.
    struct Layer {
        int x0, y0, x1, y1;  // relative to the strip, y0 even
        float whole_x, whole_y, w0, w1, w2, w3, rx, ry, lo;
    };
    struct Strip {
        int left, top, columns, rows;
        long long stride;  // floats of two rows of one plane
    };
    auto strip_of = [&](long long s) -> Strip {
        const long long in_camera = s % (across * down);
        Strip p;
        p.left = (int)(in_camera % across) * (int)strip_width;
        p.top = (int)(in_camera / across) * (int)strip_height;
        p.columns = (int)(strip_width < width - p.left ? strip_width : width - p.left);
        p.rows = (int)(strip_height < height - p.top ? strip_height : height - p.top);
        p.stride = 2 * (strip_width + @PAD@);
        return p;
    };
    auto layer_of = [](const float* r, const Strip& p) -> Layer {
        const int* box = (const int*)r + 12;
        Layer l;
        l.x0 = box[0] > p.left ? box[0] - p.left : 0;
        l.y0 = (box[1] > p.top ? box[1] - p.top : 0) & ~1;
        l.x1 = box[2] - p.left < p.columns ? box[2] - p.left : p.columns;
        l.y1 = box[3] - p.top < p.rows ? box[3] - p.top : p.rows;
        l.whole_x = r[0]; l.whole_y = r[1]; l.rx = r[2]; l.ry = r[3];
        l.w0 = r[4]; l.w1 = r[5]; l.w2 = r[6]; l.w3 = r[7]; l.lo = r[8];
        return l;
    };
"""
"""C++: where a strip lies, and a record seen from it."""


def literal(value: float) -> str:
    """`value` as a C++ float that reads back to the same number."""
    text = repr(value)
    return f"{text}f" if "." in text or "e" in text else f"{text}.f"


def snippet(body: str, rules: Rules, **words: object) -> str:
    """`body` with every @NAME@ replaced: the rules, the layout, and `words`."""
    polynomial = "(V)({})".format(literal(EXP2[rules.exp_degree][-1]))
    for coefficient in reversed(EXP2[rules.exp_degree][:-1]):
        polynomial = f"fma(f, {polynomial}, (V)({literal(coefficient)}))"
    names = {
        "POLYNOMIAL": polynomial,
        "PAD": PAD,
        "CUT": literal(math.log2(rules.alpha_min)),
        "CAP": literal(ALPHA_MAX),
        "STOP": literal(rules.transmittance_stop),
        **words,
    }
    for name, value in names.items():
        body = body.replace(f"@{name}@", str(value))
    return body
