"""Draw strips front to back: see `strips.py` for the layout and `rasterize_forward.py` for what is computed.

What the generic kernel decides on alpha is decided on its logarithm here, and 1 - alpha is applied as T - alpha T: the
same but for rounding. A pixel that has ended keeps its transmittance with a minus sign. The pixels' sums lie in planes
on a scratch of each thread until the strip is done. Two rows of a plane are followed by the same rows of the next
plane: planes apart by a power of two would compete for the same lines of the cache.
"""

import functools
import math

from oasis_kernels.constants import Rules
from oasis_kernels.rasterize.strips import LAYER, MAX_SHUFFLED, RECORD_CHANNELS, VECTORS, pixels_from_planes, snippet
from oasis_kernels.rasterize.strips_binning import BINNING, FILL, SORT, STRIPS_OF
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

DRAW = """
    const long long stride = 2 * (strip_width + @PAD@), block_size = @PLANES@ * stride;  // two rows of all planes
    const long long plane = (strip_height + 1) / 2 * stride;
    struct Ended {
        int place;
        long long first_mask;
    };
    float* planes = nullptr;
    Ended ended[@BATCH@ + 1];
    unsigned short* masks = nullptr;  // of as many layers, each as large as the strip
    Histogram* histograms = nullptr;
    share(state + 16, n_strips, [&](long long turn) {
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
            if (keep) masks = (unsigned short*)malloc(@BATCH@ * (plane / @LANES@) * sizeof(unsigned short));
            histograms = (Histogram*)malloc(3 * sizeof(Histogram));
        }
        int* list = ids + start;
        sort((unsigned long long*)entries + start, (unsigned long long*)entries + starts[n_strips] + start, list, count,
             histograms);

        int* stop = stops + s * plane;
        for (int y = 0; y < p.rows; y += 2) {
            float* t = planes + y / 2 * block_size;
            for (int x = 0; x < strip_width + @PAD@; x += @COLUMNS@) {
                const I inside = (column + (float)x < (float)p.columns) & (row + (float)y < (float)p.rows);
                store(t + 2 * x, inside ? (V)(1.f) : (V)(-1.f));
                if (keep) *(IU*)(stop + y / 2 * stride + 2 * x) = inside ? (I)(count) : (I)(0);
            }
            memset(t + stride, 0, @CHANNELS@ * stride * sizeof(float));
        }
        // Every third layer of a hand ends some pixel: a branch would be mispredicted at each. So masks of the lanes
        // that end are kept for a while, and looked at where a layer had any.
        long long n_masks = 0;
        int n_ended = 0;
        auto look = [&] {
            for (int k = 0; k < n_ended; k++) {
                const Layer l = layer_of(records + 16ll * list[ended[k].place], p);
                const unsigned short* mask = masks + ended[k].first_mask;
                for (int y = l.y0; y < l.y1; y += 2) for (int x = l.x0; x < l.x1; x += @COLUMNS@)
                    for (int bits = *mask++; bits; bits &= bits - 1)
                        stop[y / 2 * stride + 2 * x + __builtin_ctz(bits)] = ended[k].place;
            }
            n_masks = n_ended = 0;
        };
        auto any_open = [&]() -> bool {
            for (int y = 0; y < p.rows; y += 2) for (long long k = 0; k < stride; k += @LANES@)
                if (bits_of(load(planes + y / 2 * block_size + k) > 0.f)) return true;
            return false;
        };
        for (int place = 0; place < count; place++) {
            __builtin_prefetch(records + 16ll * list[place + @AHEAD@ < count ? place + @AHEAD@ : place]);
            const float* r = records + 16ll * list[place];
            const Layer l = layer_of(r, p);
            const float* color = @COLOR@;
            const long long first_mask = n_masks;
            int any = 0;
            for (int y = l.y0; y < l.y1; y += 2) {
                const V Y = row + (float)(p.top + y);
                const V dy = (Y - l.whole_y) + l.ry;
                const V u0 = fma((V)l.w1, dy, (V)(l.w0 * l.rx)), v0 = fma((V)l.w3, dy, (V)(l.w2 * l.rx));
                float* t = planes + y / 2 * block_size + 2 * l.x0;
                V X = column + (float)(p.left + l.x0);
                for (int x = l.x0; x < l.x1; x += @COLUMNS@, t += @LANES@, X += (float)@COLUMNS@) {
                    const V d = X - l.whole_x;
                    const V u = fma((V)l.w0, d, u0), v = fma((V)l.w2, d, v0);
                    const V e = fma(-v, v, fma(-u, u, (V)l.lo));
                    const V before = load(t);
                    const I drawn = (e >= cut()) & (before > 0.f)@INSIDE@;
                    const V raw = exp2(e);
                    const V alpha = drawn ? (raw < cap() ? raw : cap()) : (V)(0.f);
                    const V full = alpha * before;
                    const V after = before - full;
                    const I ends = drawn & (after <= last());
                    const V weight = ends ? (V)(0.f) : full;
                    @READ@
                    store(t, ends ? -before : after);
                    @ADD@
                    if (keep) {
                        const int bits = (int)bits_of(ends);
                        masks[n_masks++] = (unsigned short)bits;
                        any |= bits;
                    }
                }
            }
            if (keep) {
                ended[n_ended] = {place, first_mask};
                n_ended += any != 0;
                if (place % @BATCH@ == @BATCH@ - 1) look();
            }
            if (place % 256 == 255 && !any_open()) break;
        }
        if (keep) look();

        for (int y = 0; y < p.rows; y += 2) {
            const float* t = planes + y / 2 * block_size;
            float* out[2] = {picture + y * width * @CHANNELS@, picture + (y + 1) * width * @CHANNELS@};
            float* covered[2] = {cover + y * width, cover + (y + 1) * width};
            const int rows = p.rows - y < 2 ? 1 : 2;
            for (int x = 0; x < p.columns; x += @COLUMNS@, t += @LANES@) {
                const int columns = p.columns - x < @COLUMNS@ ? p.columns - x : @COLUMNS@;
                const V rest = __builtin_elementwise_abs(load(t));
                @WRITE@
            }
        }
        if (keep) for (int y = 0; y < p.rows; y += 2) {
            const float* t = planes + y / 2 * block_size;
            float* out = transmittance + s * plane + y / 2 * stride;
            for (long long k = 0; k < stride; k++) out[k] = __builtin_fabsf(t[k]);
        }
    });
    free(planes);
    free(masks);
    free(histograms);
"""

WRITE_FEW = """
                V v[@CHANNELS@];
                for (int k = 0; k < @CHANNELS@; k++) v[k] = fma((V)background[k], rest, load(t + (k + 1) * stride));
                H pixels[2][@CHANNELS@];
                pixels0(v, pixels[0]);
                pixels1(v, pixels[1]);
                const V one = 1.f - rest;
                const H alpha[2] = {one.even, one.odd};
                for (int side = 0; side < rows; side++) {
                    copy(out[side] + x * @CHANNELS@, pixels[side], columns, @CHANNELS@ * sizeof(float));
                    copy(covered[side] + x, alpha + side, columns, sizeof(float));
                }
"""

WRITE_MANY = """
                for (int side = 0; side < rows; side++) for (int c = 0; c < columns; c++) {
                    float* pixel = out[side] + (x + c) * @CHANNELS@;
                    for (int k = 0; k < @CHANNELS@; k++)
                        pixel[k] = background[k] * rest[2 * c + side] + t[(k + 1) * stride + 2 * c + side];
                    covered[side][x + c] = 1.f - rest[2 * c + side];
                }
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
    few = channels <= MAX_SHUFFLED
    sums = [f"fma((V)color[{k}], weight, load(t + {k + 1} * stride))" for k in range(channels)]
    # A few sums are read before anything is stored: what is read after a store waits for it in part.
    read = "".join(f"const V sum{k} = {value};" for k, value in enumerate(sums)) if few else ""
    add = "".join(f"store(t + {k + 1} * stride, {f'sum{k}' if few else v});" for k, v in enumerate(sums))
    color = "r + 9" if channels <= RECORD_CHANNELS else "colors + (long long)list[place] * @CHANNELS@"
    body = DRAW.replace("@WRITE@", WRITE_FEW if few else WRITE_MANY).replace("@COLOR@", color)
    body = body.replace("@READ@", read).replace("@ADD@", add).replace("@INSIDE@", inside(rules))
    text = VECTORS + (pixels_from_planes(channels) if few else "") + STRIPS_OF + LAYER + FILL + SORT + body
    words = {"CHANNELS": channels, "PLANES": channels + 1, "AHEAD": 8, "BATCH": 64}
    return native(f"draw_{channels}", BINNING | PICTURE, snippet(text, rules, **words))


DRAW_STATE = 2 * PHASE_WORDS
