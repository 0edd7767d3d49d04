// Weights alpha T of the Gaussians in each pixel, strip by strip: two sparse matrices, each the other's transpose.
//
// Strips are as wide as the image, so that a strip's pixels, and a Gaussian's strips, follow each other in both
// matrices. The strips are drawn twice, without colours. `count_weights` adds up the weights of every pixel and of
// every pair; `fill_weights` writes a pair's weights, row by row, into the matrix by Gaussians, and then goes through
// the pairs of each strip in order of memory to copy them into the matrix by pixels: both come out sorted.

void count_weights(
#include "strip_parameters.inc"
    const long long* sort_depths,  // [n], the bits of float64
    int* counts,                   // [n_chunks, n_strips]: entries, then place of the first within the strip's list
    long long* chunk_pairs,        // [n_chunks]: pairs, then number of the first
    long long* totals,             // pairs; the least depth bits; bits to drop from their differences
    long long* entries,            // [2, pairs]: scratch
    int* ids,                      // [pairs]: Gaussians of each strip, nearest first
    int* members,                  // [pairs]: the same in order of memory
    int* pair_weights,             // [pairs]: how many weights each has
    int* pixel_weights             // [height * width]
) {
#include "strip_vectors.h"
#include "strip_spans.h"
#include "strip_layer.h"
#define ENTER_ITEM                                                         \
    const long long at = starts[strip0 + strip] + place[strip0 + strip]++; \
    items[at] = item;                                                      \
    members[at] = (int)i;
#include "strip_fill.h"
#include "strip_sort.h"
#include "strip_walk.h"
    float* plane = nullptr;
    Histogram* histograms = nullptr;
    share(state + 16, n_strips, [&](long long task) {
#include "own_strip.h"
        const long long size = (strip_height + 1) / 2 * stride;
        if (!plane) {
            plane = (float*)malloc(2 * size * sizeof(float));
            histograms = (Histogram*)malloc(3 * sizeof(Histogram));
        }
        int* list = ids + start;
        sort(
            (unsigned long long*)entries + start, (unsigned long long*)entries + starts[n_strips] + start, list, count,
            histograms
        );
        int* number = (int*)(plane + size);
        memset(number, 0, size * sizeof(int));
        I of_pair = (I)(0);
        walk(
            p, list, count, plane,
            [&](int y, int x, V, I drawn) {
                of_pair -= drawn;
                IU* of_pixel = (IU*)(number + y / 2 * stride + 2 * x);
                *of_pixel -= drawn;
            },
            [](int) {},
            [&](int index) {
                pair_weights[pair_of(index, (int)s)] = __builtin_reduce_add(of_pair);
                of_pair = (I)(0);
            }
        );
        for (int y = 0; y < p.rows; y++)
            for (int x = 0; x < p.columns; x++)
                pixel_weights[(p.top + y) * width + x] = number[y / 2 * stride + 2 * x + y % 2];
    });
    free(plane);
    free(histograms);
}

void fill_weights(
#include "strip_parameters.inc"
    const int* ids,                // [pairs]: Gaussians of each strip, nearest first
    const int* members,            // [pairs]: the same in order of memory
    const long long* pair_places,  // [pairs + 1]: where the weights of each begin
    int* pixel_places,             // [height * width]: where those of each pixel begin, and at last, end
    int* gaussian_pixels,          // [weights], by Gaussian
    float* gaussian_weights,
    int* pixel_gaussians,  // [weights], by pixel
    float* pixel_values,
    float* alphas  // [height * width]
) {
#include "strip_vectors.h"
#include "strip_spans.h"
#include "strip_layer.h"
#include "strip_walk.h"
    const long long size = (strip_height + 1) / 2 * stride;
    float *plane = nullptr, *weights = nullptr, *lower_weights = nullptr;
    int *pixels = nullptr, *lower_pixels = nullptr;
    share(state, n_strips, [&](long long task) {
#include "own_strip.h"
        if (!plane) {
            plane = (float*)malloc((4 * size + 2 * (stride + 2 * LANES)) * sizeof(float));
            weights = plane + size;
            lower_weights = weights + size + LANES;
            pixels = (int*)(lower_weights + stride + LANES);
            lower_pixels = pixels + size + LANES;
        }
        // The weights of a pair, row after row. Lanes are packed without a branch: what does not count is overwritten.
        long long of_pair = 0, of_lower = 0;
        auto pack = [&](int y, int x, V weight, I drawn) {
            float lanes[LANES];
            store(lanes, weight);
            const long long bits = bits_of(drawn);
            const int first = (int)((p.top + y) * width) + x;
            auto put = [&](long long lower, float* to, int* at) -> long long {
                long long number = 0;
                for (int c = 0; c < COLUMNS; c++) {
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
            for (long long k = 0; k < of_lower; k += LANES) {
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
        for (int y = 0; y < p.rows; y++)
            for (int x = 0; x < p.columns; x++)
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
}
