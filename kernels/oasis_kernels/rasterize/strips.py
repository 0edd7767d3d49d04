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

COLUMNS = 8
"""Columns of a vector: it has two rows of them."""
RECORD = 16
"""Words of a record."""
PAD = 8
"""Columns of a strip's planes past its last."""
RECORD_CHANNELS = 3
"""Colours that fit in a record; more are read from their tensor."""
MAX_SHUFFLED = 4
"""Channels that are shuffled between planes and pixels; more are copied one by one."""
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
    typedef float V __attribute__((ext_vector_type(@LANES@)));
    typedef int I __attribute__((ext_vector_type(@LANES@)));
    typedef float VU __attribute__((ext_vector_type(@LANES@), aligned(4)));
    typedef int IU __attribute__((ext_vector_type(@LANES@), aligned(4)));
    typedef float H __attribute__((ext_vector_type(@COLUMNS@)));
    typedef float HU __attribute__((ext_vector_type(@COLUMNS@), aligned(4)));
    // Copy `columns` of `COLUMNS` elements; a size that the compiler knows is a move, another is a call.
    auto copy = [](void* to, const void* from, int columns, int element) {
        if (columns == @COLUMNS@) __builtin_memcpy(to, from, @COLUMNS@ * element);
        else memcpy(to, from, columns * element);
    };
    auto load = [](const float* p) -> V { return *(const VU*)p; };
    auto store = [](float* p, V v) { *(VU*)p = v; };
    typedef bool B __attribute__((ext_vector_type(@LANES@)));
    auto bits_of = [](I mask) -> long long {
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask, B));
    };
    auto fma = [](V a, V b, V c) -> V {
    #if defined(__FMA__) || defined(__aarch64__)
        return __builtin_elementwise_fma(a, b, c);
    #else
        return a * b + c;  // or the C library would be called for every lane
    #endif
    };
    const V column = {@COLUMN_OF_LANE@};
    const V row = {@ROW_OF_LANE@};
    // Constants, behind a pointer that the compiler cannot see through: it reads them where they are used, at no cost.
    // Known, each would be fetched through an address that takes an instruction of its own to load.
    float table[] = {@TABLE@};
    float* volatile hidden = table;
    const float* const k = hidden;
    auto magic = [&] { return (V)(k[0]); };
    auto cut = [&] { return (V)(k[1]); };
    auto cap = [&] { return (V)(k[2]); };
    auto last = [&] { return (V)(k[3]); };
    // 2^x for -126 < x < 128, garbage elsewhere: adding 1.5 * 2^23 rounds x, and leaves the whole number in the low
    // bits, from where it is added to the exponent.
    auto exp2 = [&](V x) -> V {
        const V whole = x + magic();
        const V f = x - (whole - magic());
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


def _shuffle(a: str, b: str, lanes: list[int]) -> str:
    return f"__builtin_shufflevector({a}, {b}, {', '.join(map(str, lanes))})"


def _pick(sources: list[str], wanted: list[tuple[int, int]]) -> str:
    """C++ of a vector of `COLUMNS` lanes whose lanes are `wanted`: (source, lane of it)."""
    text = sources[0]
    for k in range(1, len(sources)):
        # Lanes of later sources may be anything yet; those of earlier ones are in place after the first round.
        lanes = [
            COLUMNS + of_it if source == k else of_it if source == 0 and k == 1 else lane
            for lane, (source, of_it) in enumerate(wanted)
        ]
        text = _shuffle(text, sources[k], lanes)
    return text


def pixels_from_planes(channels: int) -> str:
    """C++: `pixels0` and `pixels1`, the upper or lower row of a vector's planes `v` as pixels, `H out[channels]`."""
    text = ""
    for row in (0, 1):
        halves = [_shuffle(f"v[{k}]", f"v[{k}]", [2 * c + row for c in range(COLUMNS)]) for k in range(channels)]
        text += f"\n    auto pixels{row} = [](const V* v, H* out) {{ "
        text += " ".join(f"const H q{k} = {half};" for k, half in enumerate(halves))
        for j in range(channels):
            wanted = [((COLUMNS * j + lane) % channels, (COLUMNS * j + lane) // channels) for lane in range(COLUMNS)]
            text += f" out[{j}] = {_pick([f'q{k}' for k in range(channels)], wanted)};"
        text += " };"
    return text


def planes_from_pixels(channels: int) -> str:
    """C++: `planes_of`, pixels of two rows, `H a[channels], b[channels]`, as a vector's planes `v`."""
    text = "\n    auto planes_of = [](const H* a, const H* b, V* v) { "
    interleaved = [c + COLUMNS * row for c in range(COLUMNS) for row in (0, 1)]
    for k in range(channels):
        wanted = [divmod(c * channels + k, COLUMNS) for c in range(COLUMNS)]
        halves = [_pick([f"{name}[{j}]" for j in range(channels)], wanted) for name in "ab"]
        text += f"v[{k}] = {_shuffle(*halves, interleaved)}; "
    return text + "};"


def literal(value: float) -> str:
    """`value` as a C++ float that reads back to the same number."""
    text = repr(value)
    return f"{text}f" if "." in text or "e" in text else f"{text}.f"


def snippet(body: str, rules: Rules, **words: object) -> str:
    """`body` with every @NAME@ replaced: the rules, the layout, and `words`."""
    table = 12582912.0, math.log2(rules.alpha_min), ALPHA_MAX, rules.transmittance_stop, *EXP2[rules.exp_degree]
    polynomial = f"(V)(k[{4 + rules.exp_degree}])"
    for k in reversed(range(rules.exp_degree)):
        polynomial = f"fma(f, {polynomial}, (V)(k[{4 + k}]))"
    lanes = range(2 * COLUMNS)
    names = {
        "LANES": len(lanes),
        "COLUMNS": COLUMNS,
        "COLUMN_OF_LANE": ", ".join(str(lane // 2) for lane in lanes),
        "ROW_OF_LANE": ", ".join(str(lane % 2) for lane in lanes),
        "TABLE": ", ".join(literal(c) for c in table),
        "POLYNOMIAL": polynomial,
        "PAD": PAD,
        **words,
    }
    for name, value in names.items():
        body = body.replace(f"@{name}@", str(value))
    return body
