// A vector's planes `v` as pixels: `pixels0` its upper row, `pixels1` its lower one.

#if CHANNELS == 1
auto pixels0 = [](const V* v, H* out) {
    const H q0 = __builtin_shufflevector(v[0], v[0], 0, 2, 4, 6, 8, 10, 12, 14);
    out[0] = q0;
};
auto pixels1 = [](const V* v, H* out) {
    const H q0 = __builtin_shufflevector(v[0], v[0], 1, 3, 5, 7, 9, 11, 13, 15);
    out[0] = q0;
};
#endif
#if CHANNELS == 3
auto pixels0 = [](const V* v, H* out) {
    const H q0 = __builtin_shufflevector(v[0], v[0], 0, 2, 4, 6, 8, 10, 12, 14);
    const H q1 = __builtin_shufflevector(v[1], v[1], 0, 2, 4, 6, 8, 10, 12, 14);
    const H q2 = __builtin_shufflevector(v[2], v[2], 0, 2, 4, 6, 8, 10, 12, 14);
    out[0] =
        __builtin_shufflevector(__builtin_shufflevector(q0, q1, 0, 8, 2, 1, 9, 5, 2, 10), q2, 0, 1, 8, 3, 4, 9, 6, 7);
    out[1] = __builtin_shufflevector(
        __builtin_shufflevector(q0, q1, 0, 3, 11, 3, 4, 12, 6, 5), q2, 10, 1, 2, 11, 4, 5, 12, 7
    );
    out[2] = __builtin_shufflevector(
        __builtin_shufflevector(q0, q1, 13, 1, 6, 14, 4, 7, 15, 7), q2, 0, 13, 2, 3, 14, 5, 6, 15
    );
};
auto pixels1 = [](const V* v, H* out) {
    const H q0 = __builtin_shufflevector(v[0], v[0], 1, 3, 5, 7, 9, 11, 13, 15);
    const H q1 = __builtin_shufflevector(v[1], v[1], 1, 3, 5, 7, 9, 11, 13, 15);
    const H q2 = __builtin_shufflevector(v[2], v[2], 1, 3, 5, 7, 9, 11, 13, 15);
    out[0] =
        __builtin_shufflevector(__builtin_shufflevector(q0, q1, 0, 8, 2, 1, 9, 5, 2, 10), q2, 0, 1, 8, 3, 4, 9, 6, 7);
    out[1] = __builtin_shufflevector(
        __builtin_shufflevector(q0, q1, 0, 3, 11, 3, 4, 12, 6, 5), q2, 10, 1, 2, 11, 4, 5, 12, 7
    );
    out[2] = __builtin_shufflevector(
        __builtin_shufflevector(q0, q1, 13, 1, 6, 14, 4, 7, 15, 7), q2, 0, 13, 2, 3, 14, 5, 6, 15
    );
};
#endif
#if CHANNELS == 4
auto pixels0 = [](const V* v, H* out) {
    const H q0 = __builtin_shufflevector(v[0], v[0], 0, 2, 4, 6, 8, 10, 12, 14);
    const H q1 = __builtin_shufflevector(v[1], v[1], 0, 2, 4, 6, 8, 10, 12, 14);
    const H q2 = __builtin_shufflevector(v[2], v[2], 0, 2, 4, 6, 8, 10, 12, 14);
    const H q3 = __builtin_shufflevector(v[3], v[3], 0, 2, 4, 6, 8, 10, 12, 14);
    out[0] = __builtin_shufflevector(
        __builtin_shufflevector(__builtin_shufflevector(q0, q1, 0, 8, 2, 3, 1, 9, 6, 7), q2, 0, 1, 8, 3, 4, 5, 9, 7),
        q3, 0, 1, 2, 8, 4, 5, 6, 9
    );
    out[1] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(q0, q1, 2, 10, 2, 3, 3, 11, 6, 7), q2, 0, 1, 10, 3, 4, 5, 11, 7
        ),
        q3, 0, 1, 2, 10, 4, 5, 6, 11
    );
    out[2] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(q0, q1, 4, 12, 2, 3, 5, 13, 6, 7), q2, 0, 1, 12, 3, 4, 5, 13, 7
        ),
        q3, 0, 1, 2, 12, 4, 5, 6, 13
    );
    out[3] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(q0, q1, 6, 14, 2, 3, 7, 15, 6, 7), q2, 0, 1, 14, 3, 4, 5, 15, 7
        ),
        q3, 0, 1, 2, 14, 4, 5, 6, 15
    );
};
auto pixels1 = [](const V* v, H* out) {
    const H q0 = __builtin_shufflevector(v[0], v[0], 1, 3, 5, 7, 9, 11, 13, 15);
    const H q1 = __builtin_shufflevector(v[1], v[1], 1, 3, 5, 7, 9, 11, 13, 15);
    const H q2 = __builtin_shufflevector(v[2], v[2], 1, 3, 5, 7, 9, 11, 13, 15);
    const H q3 = __builtin_shufflevector(v[3], v[3], 1, 3, 5, 7, 9, 11, 13, 15);
    out[0] = __builtin_shufflevector(
        __builtin_shufflevector(__builtin_shufflevector(q0, q1, 0, 8, 2, 3, 1, 9, 6, 7), q2, 0, 1, 8, 3, 4, 5, 9, 7),
        q3, 0, 1, 2, 8, 4, 5, 6, 9
    );
    out[1] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(q0, q1, 2, 10, 2, 3, 3, 11, 6, 7), q2, 0, 1, 10, 3, 4, 5, 11, 7
        ),
        q3, 0, 1, 2, 10, 4, 5, 6, 11
    );
    out[2] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(q0, q1, 4, 12, 2, 3, 5, 13, 6, 7), q2, 0, 1, 12, 3, 4, 5, 13, 7
        ),
        q3, 0, 1, 2, 12, 4, 5, 6, 13
    );
    out[3] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(q0, q1, 6, 14, 2, 3, 7, 15, 6, 7), q2, 0, 1, 14, 3, 4, 5, 15, 7
        ),
        q3, 0, 1, 2, 14, 4, 5, 6, 15
    );
};
#endif
