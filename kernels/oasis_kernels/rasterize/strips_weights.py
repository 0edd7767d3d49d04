"""Weights alpha T of the Gaussians in each pixel, strip by strip: two sparse matrices, each the other's transpose.

Strips are as wide as the image, so that a strip's pixels, and a Gaussian's strips, follow each other in both matrices.
The strips are drawn twice, without colours. `count_weights` adds up the weights of every pixel and of every pair;
`fill_weights` writes a pair's weights, row by row, into the matrix by Gaussians, and then goes through the pairs of
each strip in order of memory to copy them into the matrix by pixels: both come out sorted.
"""

import functools

from oasis_kernels.constants import Rules
from oasis_kernels.rasterize.strips import LAYER, VECTORS, snippet
from oasis_kernels.rasterize.strips_binning import BINNING, FILL, GRID, SORT, STRIPS_OF
from oasis_kernels.rasterize.strips_forward import inside
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

WALK = """
    const long long stride = 2 * (strip_width + @PAD@);
    auto pair_of = [&](long long index, int strip) -> long long {
        return pair_starts[index] + strip - (boxes[4 * index + 1] >> height_bits);
    };
    // Draw a strip: `vector(y, x, weight, drawn)` sees every vector, `row_pair(y)` follows the last of two rows, and
    // `layer(gaussian)` the last of all.
    auto walk = [&](const Strip& p, const int* list, int count, float* plane, auto&& vector, auto&& row_pair,
                    auto&& layer) {
        for (int y = 0; y < p.rows; y += 2) for (int x = 0; x < strip_width + @PAD@; x += @COLUMNS@) {
            const I inside = (column + (float)x < (float)p.columns) & (row + (float)y < (float)p.rows);
            store(plane + y / 2 * stride + 2 * x, inside ? (V)(1.f) : (V)(-1.f));
        }
        for (int place = 0; place < count; place++) {
            __builtin_prefetch(records + 16ll * list[place + 8 < count ? place + 8 : place]);
            const float* r = records + 16ll * list[place];
            const Layer l = layer_of(r, p);
            for (int y = l.y0; y < l.y1; y += 2) {
                const V Y = row + (float)(p.top + y);
                const V dy = (Y - l.whole_y) + l.ry;
                const V u0 = fma((V)l.w1, dy, (V)(l.w0 * l.rx)), v0 = fma((V)l.w3, dy, (V)(l.w2 * l.rx));
                float* t = plane + y / 2 * stride + 2 * l.x0;
                V X = column + (float)(p.left + l.x0);
                for (int x = l.x0; x < l.x1; x += @COLUMNS@, t += @LANES@, X += (float)@COLUMNS@) {
                    const V d = X - l.whole_x;
                    const V u = fma((V)l.w0, d, u0), v = fma((V)l.w2, d, v0);
                    const V e = fma(-v, v, fma(-u, u, (V)l.lo));
                    const V before = load(t);
                    const I seen = (e >= cut()) & (before > 0.f)@INSIDE@;
                    const V raw = exp2(e);
                    const V alpha = seen ? (raw < cap() ? raw : cap()) : (V)(0.f);
                    const V full = alpha * before;
                    const V after = before - full;
                    const I ends = seen & (after <= last());
                    store(t, ends ? -before : after);
                    vector(y, x, full, seen & ~ends);
                }
                row_pair(y);
            }
            layer(list[place]);
        }
    };
"""

COUNT = """
    float* plane = nullptr;
    Histogram* histograms = nullptr;
    share(state + 16, n_strips, [&](long long turn) {
        const long long s = order[turn];
        const Strip p = strip_of(s);
        const long long start = starts[s];
        const int count = (int)(starts[s + 1] - start);
        const long long size = (strip_height + 1) / 2 * stride;
        if (!plane) {
            plane = (float*)malloc(2 * size * sizeof(float));
            histograms = (Histogram*)malloc(3 * sizeof(Histogram));
        }
        int* list = ids + start;
        sort((unsigned long long*)entries + start, (unsigned long long*)entries + starts[n_strips] + start, list, count,
             histograms);
        int* number = (int*)(plane + size);
        memset(number, 0, size * sizeof(int));
        I of_pair = (I)(0);
        walk(p, list, count, plane, [&](int y, int x, V, I drawn) {
            of_pair -= drawn;
            IU* of_pixel = (IU*)(number + y / 2 * stride + 2 * x);
            *of_pixel -= drawn;
        }, [](int) {}, [&](int index) {
            pair_weights[pair_of(index, (int)s)] = __builtin_reduce_add(of_pair);
            of_pair = (I)(0);
        });
        for (int y = 0; y < p.rows; y++) for (int x = 0; x < p.columns; x++)
            pixel_weights[(p.top + y) * width + x] = number[y / 2 * stride + 2 * x + y % 2];
    });
    free(plane);
    free(histograms);
"""

WRITE = """
    const long long size = (strip_height + 1) / 2 * stride;
    float *plane = nullptr, *weights = nullptr, *lower_weights = nullptr;
    int *pixels = nullptr, *lower_pixels = nullptr;
    share(state, n_strips, [&](long long turn) {
        const long long s = order[turn];
        const Strip p = strip_of(s);
        const long long start = starts[s];
        const int count = (int)(starts[s + 1] - start);
        if (!plane) {
            plane = (float*)malloc((4 * size + 2 * (stride + 2 * @LANES@)) * sizeof(float));
            weights = plane + size;
            lower_weights = weights + size + @LANES@;
            pixels = (int*)(lower_weights + stride + @LANES@);
            lower_pixels = pixels + size + @LANES@;
        }
        // The weights of a pair, row after row. Lanes are packed without a branch: what does not count is overwritten.
        long long of_pair = 0, of_lower = 0;
        auto pack = [&](int y, int x, V weight, I drawn) {
            float lanes[@LANES@];
            store(lanes, weight);
            const long long bits = bits_of(drawn);
            const int first = (int)((p.top + y) * width) + x;
            auto put = [&](long long lower, float* to, int* at) -> long long {
                long long number = 0;
                for (int c = 0; c < @COLUMNS@; c++) {
                    to[number] = lanes[2 * c + lower];
                    at[number] = first + c + (int)(lower * width);
                    number += bits >> (2 * c + lower) & 1;
                }
                return number;
            };
            of_pair += put(0, weights + of_pair, pixels + of_pair);
            of_lower += put(1, lower_weights + of_lower, lower_pixels + of_lower);
        };
        auto append_lower = [&](int) {
            for (long long k = 0; k < of_lower; k += @LANES@) {
                store(weights + of_pair + k, load(lower_weights + k));
                *(IU*)(pixels + of_pair + k) = *(const IU*)(lower_pixels + k);
            }
            of_pair += of_lower;
            of_lower = 0;
        };
        auto write = [&](int index) {
            const long long to = pair_places[pair_of(index, (int)s)];
            memcpy(gaussian_weights + to, weights, of_pair * sizeof(float));
            memcpy(gaussian_pixels + to, pixels, of_pair * sizeof(int));
            of_pair = 0;
        };
        walk(p, ids + start, count, plane, pack, append_lower, write);
        for (int y = 0; y < p.rows; y++) for (int x = 0; x < p.columns; x++)
            alphas[(p.top + y) * width + x] = 1.f - __builtin_fabsf(plane[y / 2 * stride + 2 * x + y % 2]);
        const int* member = members + start;
        int* const next = pixel_places;
        int* const to = pixel_gaussians;
        float* const values = pixel_values;
        for (int k = 0; k < count; k++) {
            const long long index = member[k], pair = pair_of(index, (int)s);
            const long long first = pair_places[pair], number = pair_places[pair + 1] - first;
            const int* pixel = gaussian_pixels + first;
            const float* value = gaussian_weights + first;
            for (long long w = 0; w < number; w++) {
                const int place = next[pixel[w]]++;
                to[place] = (int)index;
                values[place] = value[w];
            }
        }
    });
    free(plane);
"""

FILL_MEMBERS = FILL.replace(
    "items[starts[strip0 + strip] + place[strip0 + strip]++] = item;",
    """
                const long long at = starts[strip0 + strip] + place[strip0 + strip]++;
                items[at] = item;
                members[at] = (int)i;
            """,
)

COUNTING = BINNING | {
    "entries": "long long*",  # [2, pairs]: scratch
    "ids": "int*",  # [pairs]: Gaussians of each strip, nearest first
    "members": "int*",  # [pairs]: the same in order of memory
    "pair_weights": "int*",  # [pairs]: how many weights each has
    "pixel_weights": "int*",  # [height * width]
}
FILLING = GRID | {
    "ids": "const int*",
    "members": "const int*",
    "pair_places": "const long long*",  # [pairs + 1]: where the weights of each begin
    "pixel_places": "int*",  # [height * width]: where those of each pixel begin, and at last, end
    "gaussian_pixels": "int*",  # [weights], by Gaussian
    "gaussian_weights": "float*",
    "pixel_gaussians": "int*",  # [weights], by pixel
    "pixel_values": "float*",
    "alphas": "float*",  # [height * width]
}


def _text(body: str, rules: Rules) -> str:
    return snippet((VECTORS + STRIPS_OF + LAYER + body).replace("@INSIDE@", inside(rules)), rules)


@functools.cache
def count_weights(rules: Rules) -> Native:
    """Kernel: records and counts -> sorted lists, and the number of weights of every pair and of every pixel."""
    return native("count_weights", COUNTING, _text(FILL_MEMBERS + SORT + WALK + COUNT, rules))


@functools.cache
def fill_weights(rules: Rules) -> Native:
    """Kernel: sorted lists and where weights belong -> both matrices' indices and values."""
    return native("fill_weights", FILLING, _text(WALK + WRITE, rules))


COUNT_STATE = 2 * PHASE_WORDS
FILL_STATE = PHASE_WORDS
