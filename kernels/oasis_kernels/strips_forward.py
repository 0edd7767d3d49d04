"""Draw strips front to back: see `strips.py` for the layout and `rasterize_forward.py` for what is computed.

What the generic kernel decides on alpha is decided on its logarithm here, and 1 - alpha is applied as T - alpha T: the
same but for rounding. A pixel that has ended keeps its transmittance with a minus sign. The pixels' sums lie in planes
on a scratch of each thread until the strip is done. Two rows of a plane are followed by the same rows of the next plane:
planes apart by a power of two would compete for the same lines of the cache.
"""

import functools
import math

from oasis_kernels.constants import Rules
from oasis_kernels.native import PHASE_WORDS, Native, native
from oasis_kernels.strips import LAYER, RECORD_CHANNELS, VECTORS, snippet
from oasis_kernels.strips_binning import BINNING, FILL, SORT, STRIPS_OF

DRAW = """
    const long long stride = 2 * (strip_width + @PAD@), block_size = @PLANES@ * stride;  // two rows of all planes
    const long long plane = (strip_height + 1) / 2 * stride;
    float* planes = nullptr;
    Histogram* histograms = nullptr;
    phase(state + 16, n_strips, [&](long long turn) {
        const long long s = order[turn];
        const Strip p = strip_of(s);
        const long long start = starts[s];
        const int count = (int)(starts[s + 1] - start);
        const long long camera = s / (across * down);
        const float* background = backgrounds + camera * @CHANNELS@;
        float* picture = image + ((camera * height + p.top) * width + p.left) * @CHANNELS@;
        float* cover = alphas + (camera * height + p.top) * width + p.left;
        if (count == 0 && !keep) {
            for (int y = 0; y < p.rows; y++) {
                float* out = picture + y * width * @CHANNELS@;
                for (int x = 0; x < p.columns; x++) for (int k = 0; k < @CHANNELS@; k++) *out++ = background[k];
                memset(cover + y * width, 0, p.columns * sizeof(float));
            }
            return;
        }
        if (!planes) {
            planes = (float*)malloc((strip_height + 1) / 2 * block_size * sizeof(float));
            histograms = (Histogram*)malloc(3 * sizeof(Histogram));
        }
        int* list = ids + start;
        sort((unsigned long long*)entries + start, (unsigned long long*)entries + starts[n_strips] + start, list, count,
             histograms);

        int* stop = stops + s * plane;
        for (int y = 0; y < p.rows; y += 2) {
            float* t = planes + y / 2 * block_size;
            for (int x = 0; x < strip_width + @PAD@; x += 8) {
                const I inside = (column + (float)x < (float)p.columns) & (row + (float)y < (float)p.rows);
                store(t + 2 * x, inside ? (V)(1.f) : (V)(-1.f));
                if (keep) *(IU*)(stop + y / 2 * stride + 2 * x) = inside ? (I)(count) : (I)(0);
            }
            memset(t + stride, 0, @CHANNELS@ * stride * sizeof(float));
        }
        int open = p.rows * p.columns;
        for (int place = 0; place < count && open > 0; place++) {
            __builtin_prefetch(records + 16ll * list[place + @AHEAD@ < count ? place + @AHEAD@ : place]);
            const float* r = records + 16ll * list[place];
            const Layer l = layer_of(r, p);
            const float* color = @COLOR@;
            for (int y = l.y0; y < l.y1; y += 2) {
                const V Y = row + (float)(p.top + y);
                const V dy = (Y - l.whole_y) + l.ry;
                const V u0 = fma((V)l.w1, dy, (V)(l.w0 * l.rx)), v0 = fma((V)l.w3, dy, (V)(l.w2 * l.rx));
                float* t = planes + y / 2 * block_size + 2 * l.x0;
                for (int x = l.x0; x < l.x1; x += 8, t += 16) {
                    const V X = column + (float)(p.left + x);
                    const V d = X - l.whole_x;
                    const V u = fma((V)l.w0, d, u0), v = fma((V)l.w2, d, v0);
                    const V e = fma(-v, v, fma(-u, u, (V)l.lo));
                    const V before = load(t);
                    const I drawn = (e >= @CUT@) & (before > 0.f)@INSIDE@;
                    const V raw = exp2(e);
                    const V alpha = drawn ? (raw < @CAP@ ? raw : (V)@CAP@) : (V)(0.f);
                    const V full = alpha * before;
                    const V after = before - full;
                    const I ends = drawn & (after <= @STOP@);
                    const V weight = ends ? (V)(0.f) : full;
                    store(t, ends ? -before : after);
                    @ADD@
                    if (__builtin_expect(__builtin_reduce_or(ends) != 0, 0)) {
                        for (int k = 0; k < 16; k++) if (ends[k]) {
                            if (keep) stop[y / 2 * stride + 2 * x + k] = place;
                            open--;
                        }
                    }
                }
            }
        }

        for (int y = 0; y < p.rows; y++) {
            const float* t = planes + y / 2 * block_size + y % 2;
            float* out = picture + y * width * @CHANNELS@;
            for (int x = 0; x < p.columns; x++) {
                const float rest = __builtin_fabsf(t[2 * x]);
                cover[y * width + x] = 1.f - rest;
                for (int k = 0; k < @CHANNELS@; k++)
                    *out++ = __builtin_fmaf(background[k], rest, t[(k + 1) * stride + 2 * x]);
            }
        }
        if (keep) for (int y = 0; y < p.rows; y += 2) {
            const float* t = planes + y / 2 * block_size;
            float* out = transmittance + s * plane + y / 2 * stride;
            for (long long k = 0; k < stride; k++) out[k] = __builtin_fabsf(t[k]);
        }
    });
    free(planes);
    free(histograms);
"""

PICTURE = {
    "colors": "const float*",  # [n, channels]
    "backgrounds": "const float*",  # [cameras, channels]
    "entries": "long long*",  # [2, pairs]: scratch
    "ids": "int*",  # [pairs]: Gaussians of each strip, nearest first
    "image": "float*",  # [cameras, height, width, channels]
    "alphas": "float*",  # [cameras, height, width]
    "keep": "long long",  # 1: fill the rest, for the adjoint
    "transmittance": "float*",  # [n_strips, rows of a strip / 2, 2 * (strip_width + PAD)], of the end
    "stops": "int*",  # the same: place in the strip's list of the first Gaussian that was not drawn
}

INSIDE = """
                        & (X >= (float)box[0]) & (X < (float)box[2]) & (Y >= (float)box[1]) & (Y < (float)box[3])"""


def inside(rules: Rules) -> str:
    """C++ that keeps to the box, for rules that let it cut off what is not yet too faint; else nothing."""
    cuts = rules.extent_sigmas**2 < -2 * math.log(rules.alpha_min)
    return INSIDE.replace("box", "((const int*)r + 12)").strip("\n") if cuts else ""


@functools.cache
def draw(channels: int, rules: Rules) -> Native:
    """Kernel: records and counts -> image over the backgrounds, alpha, and what the adjoint needs."""
    add = "\n".join(
        f"store(t + {k + 1} * stride, fma((V)color[{k}], weight, load(t + {k + 1} * stride)));" for k in range(channels)
    )
    color = "r + 9" if channels <= RECORD_CHANNELS else "colors + (long long)list[place] * @CHANNELS@"
    body = DRAW.replace("@COLOR@", color).replace("@ADD@", add).replace("@INSIDE@", inside(rules))
    text = VECTORS + STRIPS_OF + LAYER + FILL + SORT + body
    words = {"CHANNELS": channels, "PLANES": channels + 1, "AHEAD": 8}
    return native(f"draw_{channels}", BINNING | PICTURE, snippet(text, rules, **words))


DRAW_STATE = 2 * PHASE_WORDS
