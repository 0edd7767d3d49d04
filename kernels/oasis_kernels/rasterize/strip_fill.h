long long* items = (long long*)entries;
phase(state, n_chunks, [&](long long c) {
    const long long first = c * chunk, end = first + chunk < n ? first + chunk : n;
    const long long low = totals[1], drop = totals[2];
    int* place = counts + c * n_strips;
    const int base = (int)chunk_pairs[c];
    long long strip0 = first / per_camera * across * down, next = (first / per_camera + 1) * per_camera;
    for (long long i = first; i < end; i++) {
        if (i == next) {
            next += per_camera;
            strip0 += across * down;
        }
        const int* box = boxes + 4 * i;
        pair_starts[i] += base;
        if (!is_drawn(box)) continue;
        const long long item = ((sort_depths[i] - low) >> drop) << 31 | i;
        const Span s = span_of(box);
        each_strip(s, [&](long long strip) { ENTER_ITEM });
    }
});
