// Adjoint of the drawing of strips: see `rasterize_backward.py` for the equations and `strips.py` for the layout.
//
// Back to front from the transmittance of the end, one record per pair at the pair's number; then every Gaussian adds
// its own records in order. The sums over a pair's pixels are kept in a vector each and reduced together at the end.
void draw_backward(
#include "strip_parameters.inc"
    const float* whitenings,     // [n, 4]
    const float* opacities,      // [n]
    const float* colors,         // [n, channels]
    const float* backgrounds,    // [cameras, channels]
    const int* ids,              // [pairs]
    const float* transmittance,  // as `strips_forward.draw` kept them
    const int* stops,
    const float* g_image,      // [cameras, height, width, channels]
    const float* g_alpha,      // [cameras, height, width], or null
    float* pairs,              // [pairs, `pair_words`]
    float* strip_backgrounds,  // [n_strips, channels], or null
    float* g_means2d,          // [n, 2], not written without `shape`, as the next two
    double* g_covars2d,        // [n, 3]: by xx, by xy (which stands for both off-diagonal entries), by yy
    float* g_opacities,        // [n]
    float* g_colors            // [n, channels], not written without `color`
) {
#include "strip_vectors.h"
#if FEW_CHANNELS
#include "plane_shuffles.h"
#endif
    // Sums of the lanes of four vectors: two rounds add neighbours and interleave, two more add quarters.
    typedef float Q __attribute__((ext_vector_type(4)));
    typedef float QU __attribute__((ext_vector_type(4), aligned(4)));
    auto ab = [](V a, V b) -> V {
        return __builtin_shufflevector(a, b, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29) +
               __builtin_shufflevector(a, b, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
    };
    auto abcd = [&](V a, V b, V c, V d) -> V {
        const V p = ab(a, b), q = ab(c, d);
        return __builtin_shufflevector(p, q, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
               __builtin_shufflevector(p, q, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    };
    auto reduce = [&](V a, V b, V c, V d, float* out) {
        const V all = abcd(a, b, c, d);
        const H h = all.lo + all.hi;
        *(QU*)out = h.lo + h.hi;
    };
#include "strip_spans.h"
#include "strip_layer.h"
    const long long stride = 2 * (strip_width + PAD), block_size = PLANES * stride;
    const long long plane = (strip_height + 1) / 2 * stride;
    float* planes = nullptr;
    phase(state, n_strips, [&](long long task) {
#include "own_strip.h"
        const long long camera = s / (across * down), in_camera = s % (across * down);
        const int strip_x = (int)(in_camera % across), strip_y = (int)(in_camera / across);
        const float* background = backgrounds + camera * CHANNELS;
        const long long corner = (camera * height + p.top) * width + p.left;
        if (count == 0 && !strip_backgrounds) return;
        if (!planes) planes = (float*)malloc((strip_height + 1) / 2 * block_size * sizeof(float));

        // Two rows: T, what is seen behind (times the incoming gradient), the incoming gradient's channels.
        V g_background[CHANNELS + 1] = {};
        for (int y = 0; y < p.rows; y += 2) {
            float* t = planes + y / 2 * block_size;
            memcpy(t, transmittance + s * plane + y / 2 * stride, stride * sizeof(float));
            memset(t + stride, 0, (PLANES - 1) * stride * sizeof(float));
            const int rows = p.rows - y < 2 ? 1 : 2;
            const long long pixel[2] = {corner + y * width, corner + (y + 1) * width};
            if (g_alpha)
                for (int side = 0; side < rows; side++)
                    for (int x = 0; x < p.columns; x++) t[stride + 2 * x + side] = -g_alpha[pixel[side] + x];
            for (int x = 0; x < p.columns; x += COLUMNS) {
                const int columns = p.columns - x < COLUMNS ? p.columns - x : COLUMNS;
                float* first = t + 2 * stride + 2 * x;
#if FEW_CHANNELS
                H pixels[2][CHANNELS] = {};
                for (int side = 0; side < rows; side++)
                    copy(pixels[side], g_image + (pixel[side] + x) * CHANNELS, columns, CHANNELS * sizeof(float));
                V v[CHANNELS];
                planes_of(pixels[0], pixels[1], v);
                for (int k = 0; k < CHANNELS; k++) store(first + k * stride, v[k]);
#else
                for (int side = 0; side < rows; side++) for (int c = 0; c < columns; c++)
                    for (int k = 0; k < CHANNELS; k++)
                        first[k * stride + 2 * c + side] = g_image[(pixel[side] + x + c) * CHANNELS + k];
#endif
            }
            for (long long i = 0; i < stride; i += LANES) {
                V behind = load(t + stride + i);
                for (int k = 0; k < CHANNELS; k++) {
                    const V g = load(t + (k + 2) * stride + i);
                    behind = fma(g, (V)background[k], behind);
                    g_background[k] = fma(g, load(t + i), g_background[k]);
                }
                store(t + stride + i, behind);
            }
        }
        if (strip_backgrounds)
            for (int k = 0; k < CHANNELS; k++) {
                float sums[4];
                reduce(g_background[k], (V)(0.f), (V)(0.f), (V)(0.f), sums);
                strip_backgrounds[s * CHANNELS + k] = sums[0];
            }

        const int* list = ids + start;
        const int* stop = stops + s * plane;
        for (int place = count - 1; place >= 0; place--) {
            __builtin_prefetch(records + 16ll * list[place >= AHEAD ? place - AHEAD : place]);
            const long long index = list[place];
            const float* r = records + 16 * index;
            const Layer l = layer_of(r, p);
            const float* color = COLOR;
            const int* box = (const int*)r + 12;
            const Span span = span_of(box);
            float* out = pairs + (pair_starts[index] + (long long)(strip_y - span.y0) * (span.x1 - span.x0) +
                                  (strip_x - span.x0)) *
                                     RECORD;
            __builtin_prefetch(out, 1);
            __builtin_prefetch(out + RECORD - 1, 1);
            V m0 = {}, m1 = {}, m2 = {}, m3 = {}, m4 = {}, m5 = {};
            ACCUMULATORS
            for (int y = l.y0; y < l.y1; y += 2) {
#include "strip_row.h"
                float* t = planes + y / 2 * block_size + 2 * l.x0;
                const int* ended = stop + y / 2 * stride + 2 * l.x0;
                for (int x = l.x0; x < l.x1; x += COLUMNS, t += LANES, ended += LANES, X += (float)COLUMNS) {
#include "strip_exponent.h"
                    const I drawn = (e >= cut()) & (*(const IU*)ended > place) INSIDE;
                    const V raw = exp2(e);
                    const V alpha = drawn ? (raw < cap() ? raw : cap()) : (V)(0.f);
                    const V before = load(t) / (1.f - alpha);
                    const V weight = alpha * before;
                    READ_GRADIENTS
#if SHAPE
                    const V behind = load(t + stride);
                    const V step = STEP;
                    const V q = raw <= cap() ? weight * step : (V)(0.f);
                    const V qu = q * u, qv = q * v;
                    m0 += q;
                    m1 += qu;
                    m2 += qv;
                    m3 = fma(qu, u, m3);
                    m4 = fma(qu, v, m4);
                    m5 = fma(qv, v, m5);
                    store(t + stride, fma(alpha, step, behind));
#endif
                    ADD_COLORS
                    store(t, before);
                }
            }
            REDUCE
        }
    });
    free(planes);

    share(state + 16, n_chunks, [&](long long c) {
        typedef double D __attribute__((ext_vector_type(8)));
        const long long first = c * chunk, end = first + chunk < n ? first + chunk : n;
        for (long long i0 = first; i0 < end; i0 += 8) {
            const int many = (int)(end - i0 < 8 ? end - i0 : 8);
            alignas(64) double m[6][8], w[4][8];
            for (int j = 0; j < many; j++) {
                const long long i = i0 + j;
                const int* box = boxes + 4 * i;
                double sums[VALUES] = {};
                if (is_drawn(box)) {
                    const Span span = span_of(box);
                    const long long many_pairs = (long long)(span.x1 - span.x0) * (span.y1 - span.y0);
                    const float* record = pairs + (long long)pair_starts[i] * RECORD;
                    for (long long k = 0; k < many_pairs; k++, record += RECORD)
                        for (int v = 0; v < VALUES; v++) sums[v] += (double)record[v];
                }
                if (SHAPE) {
                    for (int k = 0; k < 6; k++) m[k][j] = sums[k];
                    for (int k = 0; k < 4; k++) w[k][j] = (double)whitenings[4 * i + k];
                    g_opacities[i] = sums[0] == 0. ? 0.f : (float)(sums[0] / (double)opacities[i]);
                }
                for (int k = 0; k < SUMMED; k++) g_colors[i * SUMMED + k] = (float)sums[6 * SHAPE + k];
            }
            if (!SHAPE) continue;
            auto at = [](double* p) -> D { return *(D*)p; };
            const double once = 1.17741002251547469, twice = 1.38629436111989062;  // out of the records' scale of W
            const D w0 = at(w[0]), w1 = at(w[1]), w2 = at(w[2]), w3 = at(w[3]);
            const D m1 = once * at(m[1]), m2 = once * at(m[2]);
            const D m3 = twice * at(m[3]), m4 = twice * at(m[4]), m5 = twice * at(m[5]);
            const D x = w0 * m1 + w2 * m2, y = w1 * m1 + w3 * m2;
            const D a = w0 * m3 + w2 * m4, b = w0 * m4 + w2 * m5;
            const D xx = 0.5 * (a * w0 + b * w2), xy = a * w1 + b * w3;
            const D yy = 0.5 * (w1 * (w1 * m3 + w3 * m4) + w3 * (w1 * m4 + w3 * m5));
            for (int j = 0; j < many; j++) {
                g_means2d[2 * (i0 + j)] = (float)x[j];
                g_means2d[2 * (i0 + j) + 1] = (float)y[j];
                double* g = g_covars2d + 3 * (i0 + j);
                g[0] = xx[j];
                g[1] = xy[j];
                g[2] = yy[j];
            }
        }
    });
}
