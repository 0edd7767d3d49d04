// A vector's planes `v` as pixels: `pixels0` its upper row, `pixels1` its lower one. The inverse of `plane_shuffles.h`.

#define LISTED(...) __VA_ARGS__
#define SHUFFLED(a, b, places) __builtin_shufflevector(a, b, LISTED places)
#define UPPER(v) SHUFFLED(v, v, (0, 2, 4, 6, 8, 10, 12, 14))
#define LOWER(v) SHUFFLED(v, v, (1, 3, 5, 7, 9, 11, 13, 15))

#if CHANNELS == 1
auto in_pixels = [](const H* q, H* out) { out[0] = q[0]; };
#endif
#if CHANNELS == 3
#define OF_CHANNELS(two, three) SHUFFLED(SHUFFLED(q[0], q[1], two), q[2], three)
auto in_pixels = [](const H* q, H* out) {
    out[0] = OF_CHANNELS((0, 8, 2, 1, 9, 5, 2, 10), (0, 1, 8, 3, 4, 9, 6, 7));
    out[1] = OF_CHANNELS((0, 3, 11, 3, 4, 12, 6, 5), (10, 1, 2, 11, 4, 5, 12, 7));
    out[2] = OF_CHANNELS((13, 1, 6, 14, 4, 7, 15, 7), (0, 13, 2, 3, 14, 5, 6, 15));
};
#endif
#if CHANNELS == 4
#define OF_CHANNELS(two, three, four) SHUFFLED(SHUFFLED(SHUFFLED(q[0], q[1], two), q[2], three), q[3], four)
auto in_pixels = [](const H* q, H* out) {
    out[0] = OF_CHANNELS((0, 8, 2, 3, 1, 9, 6, 7), (0, 1, 8, 3, 4, 5, 9, 7), (0, 1, 2, 8, 4, 5, 6, 9));
    out[1] = OF_CHANNELS((2, 10, 2, 3, 3, 11, 6, 7), (0, 1, 10, 3, 4, 5, 11, 7), (0, 1, 2, 10, 4, 5, 6, 11));
    out[2] = OF_CHANNELS((4, 12, 2, 3, 5, 13, 6, 7), (0, 1, 12, 3, 4, 5, 13, 7), (0, 1, 2, 12, 4, 5, 6, 13));
    out[3] = OF_CHANNELS((6, 14, 2, 3, 7, 15, 6, 7), (0, 1, 14, 3, 4, 5, 15, 7), (0, 1, 2, 14, 4, 5, 6, 15));
};
#endif
auto pixels0 = [&](const V* v, H* out) {
    H q[CHANNELS];
    for (int k = 0; k < CHANNELS; k++) q[k] = UPPER(v[k]);
    in_pixels(q, out);
};
auto pixels1 = [&](const V* v, H* out) {
    H q[CHANNELS];
    for (int k = 0; k < CHANNELS; k++) q[k] = LOWER(v[k]);
    in_pixels(q, out);
};
