typedef int Histogram[2048];
// Sort a strip's entries (in `items`, with room as large again in `spare`) and write their Gaussians to `ids`.
auto sort =
    [&](unsigned long long* items, unsigned long long* spare, int* ids, long long count, Histogram* histograms) {
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
