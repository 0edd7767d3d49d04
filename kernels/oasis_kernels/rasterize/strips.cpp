// Float32 rasterization on the CPU: what binning, drawing and its adjoint share.
//
// The image is cut into strips, `strip_width` x `strip_height` pixels (an even number of rows); a pair is one
// (Gaussian, strip). A strip has planes (transmittance, one a channel, ...) whose pixels lie in vectors of 16: 8
// columns of 2 neighbouring rows, pixel (x, y) in lane 2 x + y % 2 of its two rows. A vector may begin at any column:
// splats are about as wide as a vector, and fixed blocks of columns would cut most of them in two. What a vector reads
// or writes past the last column lies in `PAD` more columns, past the last row in the odd one; these pixels count as
// ended.
//
// A drawn Gaussian is one record of 16 words, a cache line:
//
//     0  whole x, whole y of its centre     4  W, by rows, scaled so that alpha = 2^(lo - |W d|^2)
//     2  0.5 - remainder x, y               8  lo = log2(opacity)
//                                           9  colours, where there are at most 3
//                                          12  box x0, y0, x1, y1 (past the end), integers
//
// Strips, tasks and records never depend on the number of threads, nor on whether a gradient will be asked for.

// Draw strips front to back: see `strips.py` for the layout and `rasterize_forward.py` for what is computed.
//
// What the generic kernel decides on alpha is decided on its logarithm here, and 1 - alpha is applied as T - alpha T:
// the same but for rounding. A pixel that has ended keeps its transmittance with a minus sign. The pixels' sums lie in
// planes on a scratch of each thread until the strip is done. Two rows of a plane are followed by the same rows of the
// next plane: planes apart by a power of two would compete for the same lines of the cache.
void draw(
#include "strip_parameters.inc"
    const long long* sort_depths,  // [n], the bits of float64
    int* counts,                   // [n_chunks, n_strips]: entries, then place of the first within the strip's list
    long long* chunk_pairs,        // [n_chunks]: pairs, then number of the first
    long long* totals,             // pairs; the least depth bits; bits to drop from their differences
    const float* colors,           // [n, channels]
    const float* backgrounds,      // [cameras, channels]
    long long* entries,            // [2, pairs]: scratch
    int* ids,                      // [pairs]: Gaussians of each strip, nearest first
    float* image,                  // [cameras, height, width, channels]
    float* alphas,                 // [cameras, height, width]
    long long keep,                // 1: fill the rest, for the adjoint
    float* transmittance,          // [n_strips, rows of a strip / 2, 2 * (strip_width + PAD)], of the end
    int* stops                     // the same: place in the strip's list of the first Gaussian that was not drawn
) {
#include "strip_vectors.h"
#if FEW_CHANNELS
#include "pixel_shuffles.h"
#endif
#include "strip_spans.h"
#include "strip_layer.h"
#define ENTER_ITEM items[starts[strip0 + strip] + place[strip0 + strip]++] = item;
#include "strip_fill.h"
#include "strip_sort.h"
    const long long stride = 2 * (strip_width + PAD), block_size = PLANES * stride;  // two rows of all planes
    const long long plane = (strip_height + 1) / 2 * stride;
    struct Ended {
        int place;
        long long first_mask;
    };
    float* planes = nullptr;
    Ended ended[BATCH + 1];
    unsigned short* masks = nullptr;  // of as many layers, each as large as the strip
    Histogram* histograms = nullptr;
    share(state + 16, n_strips, [&](long long task) {
#include "own_strip.h"
        const long long camera = s / (across * down);
        const float* background = backgrounds + camera * CHANNELS;
        float* picture = image + ((camera * height + p.top) * width + p.left) * CHANNELS;
        float* cover = alphas + (camera * height + p.top) * width + p.left;
        if (count == 0 && !keep) {
            for (int y = 0; y < p.rows; y++) {
                float* out = picture + y * width * CHANNELS;
                for (int x = 0; x < p.columns; x++)
                    for (int k = 0; k < CHANNELS; k++) *out++ = background[k];
                memset(cover + y * width, 0, p.columns * sizeof(float));
            }
            return;
        }
        if (!planes) {
            planes = (float*)malloc((strip_height + 1) / 2 * block_size * sizeof(float));
            if (keep) masks = (unsigned short*)malloc(BATCH * (plane / LANES) * sizeof(unsigned short));
            histograms = (Histogram*)malloc(3 * sizeof(Histogram));
        }
        int* list = ids + start;
        sort(
            (unsigned long long*)entries + start, (unsigned long long*)entries + starts[n_strips] + start, list, count,
            histograms
        );

        int* stop = stops + s * plane;
        for (int y = 0; y < p.rows; y += 2) {
            float* t = planes + y / 2 * block_size;
            for (int x = 0; x < strip_width + PAD; x += COLUMNS) {
                const I inside = (column + (float)x < (float)p.columns) & (row + (float)y < (float)p.rows);
                store(t + 2 * x, inside ? (V)(1.f) : (V)(-1.f));
                if (keep) *(IU*)(stop + y / 2 * stride + 2 * x) = inside ? (I)(count) : (I)(0);
            }
            memset(t + stride, 0, CHANNELS * stride * sizeof(float));
        }
        // Every third layer of a hand ends some pixel: a branch would be mispredicted at each. So masks of the lanes
        // that end are kept for a while, and looked at where a layer had any.
        long long n_masks = 0;
        int n_ended = 0;
        auto look = [&] {
            for (int k = 0; k < n_ended; k++) {
                const Layer l = layer_of(records + 16ll * list[ended[k].place], p);
                const unsigned short* mask = masks + ended[k].first_mask;
                for (int y = l.y0; y < l.y1; y += 2)
                    for (int x = l.x0; x < l.x1; x += COLUMNS)
                        for (int bits = *mask++; bits; bits &= bits - 1)
                            stop[y / 2 * stride + 2 * x + __builtin_ctz(bits)] = ended[k].place;
            }
            n_masks = n_ended = 0;
        };
        auto any_open = [&]() -> bool {
            for (int y = 0; y < p.rows; y += 2)
                for (long long k = 0; k < stride; k += LANES)
                    if (bits_of(load(planes + y / 2 * block_size + k) > 0.f)) return true;
            return false;
        };
        for (int place = 0; place < count; place++) {
            __builtin_prefetch(records + 16ll * list[place + AHEAD < count ? place + AHEAD : place]);
            const float* r = records + 16ll * list[place];
            const Layer l = layer_of(r, p);
            const float* color = COLOR;
            const long long first_mask = n_masks;
            int any = 0;
            for (int y = l.y0; y < l.y1; y += 2) {
#include "strip_row.h"
                float* t = planes + y / 2 * block_size + 2 * l.x0;
                for (int x = l.x0; x < l.x1; x += COLUMNS, t += LANES, X += (float)COLUMNS) {
#include "strip_blend.h"
                    const V weight = ends ? (V)(0.f) : full;
                    READ
                    store(t, ends ? -before : after);
                    ADD
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
                if (place % BATCH == BATCH - 1) look();
            }
            if (place % 256 == 255 && !any_open()) break;
        }
        if (keep) look();

        for (int y = 0; y < p.rows; y += 2) {
            const float* t = planes + y / 2 * block_size;
            float* out[2] = {picture + y * width * CHANNELS, picture + (y + 1) * width * CHANNELS};
            float* covered[2] = {cover + y * width, cover + (y + 1) * width};
            const int rows = p.rows - y < 2 ? 1 : 2;
            for (int x = 0; x < p.columns; x += COLUMNS, t += LANES) {
                const int columns = p.columns - x < COLUMNS ? p.columns - x : COLUMNS;
                const V rest = __builtin_elementwise_abs(load(t));
#if FEW_CHANNELS
                V v[CHANNELS];
                for (int k = 0; k < CHANNELS; k++) v[k] = fma((V)background[k], rest, load(t + (k + 1) * stride));
                H pixels[2][CHANNELS];
                pixels0(v, pixels[0]);
                pixels1(v, pixels[1]);
                const V one = 1.f - rest;
                const H alpha[2] = {one.even, one.odd};
                for (int side = 0; side < rows; side++) {
                    copy(out[side] + x * CHANNELS, pixels[side], columns, CHANNELS * sizeof(float));
                    copy(covered[side] + x, alpha + side, columns, sizeof(float));
                }
#else
                for (int side = 0; side < rows; side++) for (int c = 0; c < columns; c++) {
                    float* pixel = out[side] + (x + c) * CHANNELS;
                    for (int k = 0; k < CHANNELS; k++)
                        pixel[k] = background[k] * rest[2 * c + side] + t[(k + 1) * stride + 2 * c + side];
                    covered[side][x + c] = 1.f - rest[2 * c + side];
                }
#endif
            }
        }
        if (keep)
            for (int y = 0; y < p.rows; y += 2) {
                const float* t = planes + y / 2 * block_size;
                float* out = transmittance + s * plane + y / 2 * stride;
                for (long long k = 0; k < stride; k++) out[k] = __builtin_fabsf(t[k]);
            }
    });
    free(planes);
    free(masks);
    free(histograms);
}
