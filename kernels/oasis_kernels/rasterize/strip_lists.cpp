// Records of the drawn Gaussians, and each strip's list of them, nearest first.
//
// `collect` goes through the Gaussians in chunks: it writes their records and counts, chunk by chunk, what each strip
// will get. From the counts follows where every chunk's entries of a strip's list begin, so that `FILL`, with which
// drawing begins, can write them in any order of the chunks. Each strip then sorts its own list: no step is serial but
// the adding up of the counts.
//
// An entry is one 64-bit word, depth key over index: sorting whole words orders by depth and breaks ties by index. The
// key is the leading 33 of the bits in which the depths of this call differ. Depths are positive float64, so their bits
// sort as integers do.

void collect(
#include "strip_parameters.inc"
    const long long* sort_depths,  // [n], the bits of float64
    int* counts,                   // [n_chunks, n_strips]: entries, then place of the first within the strip's list
    long long* chunk_pairs,        // [n_chunks]: pairs, then number of the first
    long long* totals,             // pairs; the least depth bits; bits to drop from their differences
    const float* centers,          // [n, 4]
    const float* whitenings,       // [n, 4]
    const float* opacities,        // [n]
    const float* colors,           // [n, channels]
    long long* lows,               // [n_chunks]: least and largest depth bits
    long long* highs
) {
#include "strip_vectors.h"
#include "strip_spans.h"
    // log2 of normal numbers: exponent, and the series of artanh for a mantissa between sqrt(1/2) and sqrt(2).
    auto log2 = [](V x) -> V {
        const I bits = __builtin_bit_cast(I, x), above = (bits - 0x3f3504f3) >> 23;
        const V m = __builtin_bit_cast(V, bits - (above << 23)), s = (m - 1.f) / (m + 1.f), q = s * s;
        return __builtin_convertvector(above, V) +
               s * (2.885390082f + q * (0.9617966939f + q * (0.5770780164f + q * (0.4121985832f + q * 0.3205988980f))));
    };
    auto finite = [](float w) -> float { return w > 1e18f ? 1e18f : w < -1e18f ? -1e18f : w; };
    phase(state, n_chunks, [&](long long c) {
        const long long first = c * chunk, end = first + chunk < n ? first + chunk : n;
        int* count = counts + c * n_strips;
        memset(count, 0, n_strips * sizeof(int));
        long long pairs = 0, low = 0x7fffffffffffffffll, high = 0;
        long long camera = first / per_camera, next = (camera + 1) * per_camera;
        float logs[LANES];
        int* of_camera = count + camera * across * down;
        for (long long i = first; i < end; i++) {
            if (i == next) {
                next += per_camera;
                of_camera += across * down;
            }
            if ((i - first) % LANES == 0) {
                V some = (V)(1.f);
                memcpy(&some, opacities + i, (end - i < LANES ? end - i : LANES) * sizeof(float));
                store(logs, log2(some));
            }
            const int* box = boxes + 4 * i;
            pair_starts[i] = (int)pairs;
            if (!is_drawn(box)) continue;
            const Span s = span_of(box);
            pairs += each_strip(s, [&](long long strip) { of_camera[strip]++; });
            low = sort_depths[i] < low ? sort_depths[i] : low;
            high = sort_depths[i] > high ? sort_depths[i] : high;
            float* r = records + 16 * i;
            const float *center = centers + 4 * i, *w = whitenings + 4 * i;
            r[0] = center[0];
            r[1] = center[1];
            r[2] = 0.5f - center[2];
            r[3] = 0.5f - center[3];
            // sqrt(log2(e) / 2); capped, so that no lane far outside becomes infinite and poisons a masked sum
            for (int k = 0; k < 4; k++) r[4 + k] = finite(0.8493218003f * w[k]);
            r[8] = logs[(i - first) % LANES];
            for (int k = 0; k < IN_RECORD; k++) r[9 + k] = colors[IN_RECORD * i + k];
            memcpy(r + 12, box, 4 * sizeof(int));
        }
        chunk_pairs[c] = pairs;
        lows[c] = low;
        highs[c] = high;
    });
    share(state + 16, 1, [&](long long) {
        long long pairs = 0, low = 0x7fffffffffffffffll, high = 0, place = 0;
        for (long long c = 0; c < n_chunks; c++) {
            const long long here = chunk_pairs[c];
            chunk_pairs[c] = pairs;
            pairs += here;
            low = lows[c] < low ? lows[c] : low;
            high = highs[c] > high ? highs[c] : high;
        }
        for (long long s = 0; s < n_strips; s++) {
            starts[s] = place;
            int within = 0;
            for (long long c = 0; c < n_chunks; c++) {
                const int here = counts[c * n_strips + s];
                counts[c * n_strips + s] = within;
                within += here;
            }
            place += within;
        }
        starts[n_strips] = place;
        // Strips by the leading bit of their counts, longest first: threads that end together waste no time.
        int place_of[65] = {};
        auto rank = [&](long long s) -> int {
            const long long count = starts[s + 1] - starts[s];
            return count ? __builtin_clzll(count) : 64;
        };
        for (long long s = 0; s < n_strips; s++)
            if (rank(s) < 64) place_of[rank(s) + 1]++;
        for (int k = 1; k < 65; k++) place_of[k] += place_of[k - 1];
        for (long long s = 0; s < n_strips; s++) order[place_of[rank(s)]++] = (int)s;
        totals[0] = pairs;
        totals[1] = low;
        totals[2] = high <= low ? 0 : 31 - __builtin_clzll(high - low);  // 33 bits are left of 64 - clz
        if (totals[2] < 0) totals[2] = 0;
    });
}
