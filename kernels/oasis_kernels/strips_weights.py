"""Weights alpha T of the Gaussians in each pixel, strip by strip: two sparse matrices, each the other's transpose.

Strips are as wide as the image, so that a strip's pixels, and a Gaussian's strips, follow each other in both matrices.
The strips are drawn twice, without colours. `count_weights` adds up the weights of every pixel and of every pair;
`fill_weights` writes a pair's weights, row by row, into the matrix by Gaussians, and then goes through the pairs of each
strip in order of memory to copy them into the matrix by pixels: both come out sorted.
"""

import functools

from oasis_kernels.constants import Rules
from oasis_kernels.native import PHASE_WORDS, Native, native
from oasis_kernels.strips import LAYER, VECTORS, snippet
from oasis_kernels.strips_binning import BINNING, FILL, GRID, SORT, STRIPS_OF
from oasis_kernels.strips_forward import inside

WALK = """
    const long long stride = 2 * (strip_width + @PAD@);
    auto pair_of = [&](long long index, int strip) -> long long {
        return pair_starts[index] + strip - (boxes[4 * index + 1] >> height_bits);
    };
    // Draw a strip on plane `t`: `vector(place, y, x, weight, drawn)` sees every vector, `layer(place)` follows its last.
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
    phase(state + 16, n_strips, [&](long long turn) {
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
    float* plane = nullptr;
    float* weights = nullptr;
    int* pixels = nullptr;
    phase(state, n_strips, [&](long long turn) {
        const long long s = order[turn];
        const Strip p = strip_of(s);
        const long long start = starts[s];
        const int count = (int)(starts[s + 1] - start);
        if (!plane) {
            plane = (float*)malloc((strip_height + 1) / 2 * stride * sizeof(float));
            weights = (float*)malloc(stride * sizeof(float));
            pixels = (int*)malloc(stride * sizeof(int));
        }
        // A vector's weights of the upper and of the lower row, packed together without a branch.
        int number[2] = {0, 0};
        long long of_pair = 0;
        int current = 0;
        auto pack = [&](int y, int x, V weight, I drawn) {
            for (int side = 0; side < 2; side++) {
                const long long half = side * stride / 2;
                int n = number[side];
                const int first = (int)((p.top + y + side) * width) + x;
                for (int c = 0; c < @COLUMNS@; c++) {
                    weights[half + n] = weight[2 * c + side];
                    pixels[half + n] = first + c;
                    n -= drawn[2 * c + side];
                }
                number[side] = n;
            }
        };
        auto flush = [&](int) {
            for (int side = 0; side < 2; side++) {
                const long long half = side * stride / 2;
                const long long to = pair_places[pair_of(ids[start + current], (int)s)] + of_pair;
                memcpy(gaussian_weights + to, weights + half, number[side] * sizeof(float));
                memcpy(gaussian_pixels + to, pixels + half, number[side] * sizeof(int));
                of_pair += number[side];
                number[side] = 0;
            }
        };
        walk(p, ids + start, count, plane, pack, flush, [&](int) {
            current++;
            of_pair = 0;
        });
        const int* member = members + start;
        for (int k = 0; k < count; k++) {
            const long long index = member[k], pair = pair_of(index, (int)s);
            for (long long w = pair_places[pair]; w < pair_places[pair + 1]; w++) {
                const long long place = pixel_places[gaussian_pixels[w]]++;
                pixel_gaussians[place] = (int)index;
                pixel_values[place] = gaussian_weights[w];
            }
        }
    });
    free(plane);
    free(weights);
    free(pixels);
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
