"""Records of the drawn Gaussians, and each strip's list of them, nearest first.

`collect` goes through the Gaussians in chunks: it writes their records and counts, chunk by chunk, what each strip will
get. From the counts follows where every chunk's entries of a strip's list begin, so that `FILL`, with which drawing
begins, can write them in any order of the chunks. Each strip then sorts its own list: no step is serial but the adding
up of the counts.

An entry is one 64-bit word, depth key over index: sorting whole words orders by depth and breaks ties by index. The key
is the leading 33 of the bits in which the depths of this call differ. Depths are positive float64, so their bits sort
as integers do.
"""

import functools

from oasis_kernels.constants import Rules
from oasis_kernels.rasterize.strips import VECTORS, snippet
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

GRID = {
    "n": "long long",  # cameras * per_camera, as all arrays of Gaussians
    "per_camera": "long long",
    "n_chunks": "long long",
    "chunk": "long long",  # Gaussians of a chunk
    "width": "long long",
    "height": "long long",
    "strip_width": "long long",
    "strip_height": "long long",
    "across": "long long",  # strips of an image
    "down": "long long",
    "n_strips": "long long",  # of all images
    "boxes": "const int*",  # [n, 4]
    "records": "float*",  # [n, 16]
    "starts": "long long*",  # [n_strips + 1]: first place of each strip's list
    "pair_starts": "int*",  # [n]: number of a Gaussian's first pair
    "order": "int*",  # [n_strips]: strips, those with much to do first
    "state": "long long*",  # zeros come in
}
"""Parameters that every kernel over strips begins with."""

BINNING = GRID | {
    "sort_depths": "const long long*",  # [n], the bits of float64
    "counts": "int*",  # [n_chunks, n_strips]: entries, then place of the first within the strip's list
    "chunk_pairs": "long long*",  # [n_chunks]: pairs, then number of the first
    "totals": "long long*",  # pairs; the least depth bits; bits to drop from their differences
}
"""Parameters of the kernels that fill lists."""

STRIPS_OF = """
    const int width_bits = __builtin_ctzll(strip_width), height_bits = __builtin_ctzll(strip_height);
    struct Span { int x0, y0, x1, y1; };  // strips, past the end
    auto span_of = [&](const int* box) -> Span {
        return {box[0] >> width_bits, box[1] >> height_bits, ((box[2] - 1) >> width_bits) + 1,
                ((box[3] - 1) >> height_bits) + 1};
    };
    // The strips of a span, one loop with one way out: most spans have one strip.
    auto each_strip = [&](const Span& s, auto&& visit) {
        long long strip = (long long)s.y0 * across + s.x0;
        const int wide = s.x1 - s.x0, number = wide * (s.y1 - s.y0);
        for (int k = 0, x = 0; k < number; k++) {
            visit(strip);
            x++;
            strip += x == wide ? across - wide + 1 : 1;
            x = x == wide ? 0 : x;
        }
        return number;
    };
    auto is_drawn = [](const int* box) -> bool { return box[0] < box[2] && box[1] < box[3]; };
"""

COLLECT = """
    // log2 of normal numbers: exponent, and the series of artanh for a mantissa between sqrt(1/2) and sqrt(2).
    auto log2 = [](V x) -> V {
        const I bits = __builtin_bit_cast(I, x), above = (bits - 0x3f3504f3) >> 23;
        const V m = __builtin_bit_cast(V, bits - (above << 23)), s = (m - 1.f) / (m + 1.f), q = s * s;
        return __builtin_convertvector(above, V) + s * (2.885390082f + q * (0.9617966939f + q * (0.5770780164f
               + q * (0.4121985832f + q * 0.3205988980f))));
    };
    auto finite = [](float w) -> float { return w > 1e18f ? 1e18f : w < -1e18f ? -1e18f : w; };
    phase(state, n_chunks, [&](long long c) {
        const long long first = c * chunk, end = first + chunk < n ? first + chunk : n;
        int* count = counts + c * n_strips;
        memset(count, 0, n_strips * sizeof(int));
        long long pairs = 0, low = 0x7fffffffffffffffll, high = 0;
        long long camera = first / per_camera, next = (camera + 1) * per_camera;
        float logs[@LANES@];
        int* of_camera = count + camera * across * down;
        for (long long i = first; i < end; i++) {
            if (i == next) { next += per_camera; of_camera += across * down; }
            if ((i - first) % @LANES@ == 0) {
                V some = (V)(1.f);
                memcpy(&some, opacities + i, (end - i < @LANES@ ? end - i : @LANES@) * sizeof(float));
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
            r[0] = center[0]; r[1] = center[1]; r[2] = 0.5f - center[2]; r[3] = 0.5f - center[3];
            // sqrt(log2(e) / 2); capped, so that no lane far outside becomes infinite and poisons a masked sum
            for (int k = 0; k < 4; k++) r[4 + k] = finite(0.8493218003f * w[k]);
            r[8] = logs[(i - first) % @LANES@];
            for (int k = 0; k < @IN_RECORD@; k++) r[9 + k] = colors[@IN_RECORD@ * i + k];
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
        for (long long s = 0; s < n_strips; s++) if (rank(s) < 64) place_of[rank(s) + 1]++;
        for (int k = 1; k < 65; k++) place_of[k] += place_of[k - 1];
        for (long long s = 0; s < n_strips; s++) order[place_of[rank(s)]++] = (int)s;
        totals[0] = pairs;
        totals[1] = low;
        totals[2] = high <= low ? 0 : 31 - __builtin_clzll(high - low);  // 33 bits are left of 64 - clz
        if (totals[2] < 0) totals[2] = 0;
    });
"""

FILL = """
    long long* items = (long long*)entries;
    phase(state, n_chunks, [&](long long c) {
        const long long first = c * chunk, end = first + chunk < n ? first + chunk : n;
        const long long low = totals[1], drop = totals[2];
        int* place = counts + c * n_strips;
        const int base = (int)chunk_pairs[c];
        long long strip0 = first / per_camera * across * down, next = (first / per_camera + 1) * per_camera;
        for (long long i = first; i < end; i++) {
            if (i == next) { next += per_camera; strip0 += across * down; }
            const int* box = boxes + 4 * i;
            pair_starts[i] += base;
            if (!is_drawn(box)) continue;
            const long long item = ((sort_depths[i] - low) >> drop) << 31 | i;
            const Span s = span_of(box);
            each_strip(s, [&](long long strip) { items[starts[strip0 + strip] + place[strip0 + strip]++] = item; });
        }
    });
"""
"""C++: phase 0 of drawing, every strip's entries in order of memory."""

SORT = """
    typedef int Histogram[2048];
    // Sort a strip's entries (in `items`, with room as large again in `spare`) and write their Gaussians to `ids`.
    auto sort = [&](unsigned long long* items, unsigned long long* spare, int* ids, long long count,
                    Histogram* histograms) {
        if (count < 64) {
            for (long long k = 1; k < count; k++) {
                const unsigned long long item = items[k];
                long long j = k;
                for (; j > 0 && items[j - 1] > item; j--) items[j] = items[j - 1];
                items[j] = item;
            }
            for (long long k = 0; k < count; k++) ids[k] = (int)(items[k] & 0x7fffffff);
            return;
        }
        // Least digit first, 11 bits at a time; the order of memory that comes in settles ties.
        memset(histograms, 0, 3 * sizeof(Histogram));
        for (long long k = 0; k < count; k++) {
            histograms[0][items[k] >> 31 & 2047]++;
            histograms[1][items[k] >> 42 & 2047]++;
            histograms[2][items[k] >> 53]++;
        }
        for (int digit = 0; digit < 3; digit++) {
            int place = 0;
            for (int b = 0; b < 2048; b++) {
                const int here = histograms[digit][b];
                histograms[digit][b] = place;
                place += here;
            }
        }
        for (long long k = 0; k < count; k++) spare[histograms[0][items[k] >> 31 & 2047]++] = items[k];
        for (long long k = 0; k < count; k++) items[histograms[1][spare[k] >> 42 & 2047]++] = spare[k];
        for (long long k = 0; k < count; k++) ids[histograms[2][items[k] >> 53]++] = (int)(items[k] & 0x7fffffff);
    };
"""
"""C++: `sort`, one strip's list."""


@functools.cache
def collect(channels: int) -> Native:
    """Kernel: projected Gaussians -> records, and how long each strip's list will be. `channels` in a record, or 0."""
    extra = {
        "centers": "const float*",  # [n, 4]
        "whitenings": "const float*",  # [n, 4]
        "opacities": "const float*",  # [n]
        "colors": "const float*",  # [n, channels]
        "lows": "long long*",  # [n_chunks]: least and largest depth bits
        "highs": "long long*",
    }
    body = snippet(VECTORS + STRIPS_OF + COLLECT, Rules(), IN_RECORD=channels)
    return native(f"collect_{channels}", BINNING | extra, body)


COLLECT_STATE = 2 * PHASE_WORDS
