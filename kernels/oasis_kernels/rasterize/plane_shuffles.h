// Pixels of two rows as a vector's planes `v`.

#if CHANNELS == 1
auto planes_of = [](const H* a, const H* b, V* v) {
    v[0] = __builtin_shufflevector(a[0], b[0], 0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
};
#endif
#if CHANNELS == 3
auto planes_of = [](const H* a, const H* b, V* v) {
    v[0] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(a[0], a[1], 0, 3, 6, 9, 12, 15, 6, 7), a[2], 0, 1, 2, 3, 4, 5, 10, 13
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(b[0], b[1], 0, 3, 6, 9, 12, 15, 6, 7), b[2], 0, 1, 2, 3, 4, 5, 10, 13
        ),
        0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15
    );
    v[1] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(a[0], a[1], 1, 4, 7, 10, 13, 5, 6, 7), a[2], 0, 1, 2, 3, 4, 8, 11, 14
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(b[0], b[1], 1, 4, 7, 10, 13, 5, 6, 7), b[2], 0, 1, 2, 3, 4, 8, 11, 14
        ),
        0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15
    );
    v[2] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(a[0], a[1], 2, 5, 8, 11, 14, 5, 6, 7), a[2], 0, 1, 2, 3, 4, 9, 12, 15
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(b[0], b[1], 2, 5, 8, 11, 14, 5, 6, 7), b[2], 0, 1, 2, 3, 4, 9, 12, 15
        ),
        0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15
    );
};
#endif
#if CHANNELS == 4
auto planes_of = [](const H* a, const H* b, V* v) {
    v[0] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(a[0], a[1], 0, 4, 8, 12, 4, 5, 6, 7), a[2], 0, 1, 2, 3, 8, 12, 6, 7
            ),
            a[3], 0, 1, 2, 3, 4, 5, 8, 12
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(b[0], b[1], 0, 4, 8, 12, 4, 5, 6, 7), b[2], 0, 1, 2, 3, 8, 12, 6, 7
            ),
            b[3], 0, 1, 2, 3, 4, 5, 8, 12
        ),
        0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15
    );
    v[1] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(a[0], a[1], 1, 5, 9, 13, 4, 5, 6, 7), a[2], 0, 1, 2, 3, 9, 13, 6, 7
            ),
            a[3], 0, 1, 2, 3, 4, 5, 9, 13
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(b[0], b[1], 1, 5, 9, 13, 4, 5, 6, 7), b[2], 0, 1, 2, 3, 9, 13, 6, 7
            ),
            b[3], 0, 1, 2, 3, 4, 5, 9, 13
        ),
        0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15
    );
    v[2] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(a[0], a[1], 2, 6, 10, 14, 4, 5, 6, 7), a[2], 0, 1, 2, 3, 10, 14, 6, 7
            ),
            a[3], 0, 1, 2, 3, 4, 5, 10, 14
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(b[0], b[1], 2, 6, 10, 14, 4, 5, 6, 7), b[2], 0, 1, 2, 3, 10, 14, 6, 7
            ),
            b[3], 0, 1, 2, 3, 4, 5, 10, 14
        ),
        0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15
    );
    v[3] = __builtin_shufflevector(
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(a[0], a[1], 3, 7, 11, 15, 4, 5, 6, 7), a[2], 0, 1, 2, 3, 11, 15, 6, 7
            ),
            a[3], 0, 1, 2, 3, 4, 5, 11, 15
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(
                __builtin_shufflevector(b[0], b[1], 3, 7, 11, 15, 4, 5, 6, 7), b[2], 0, 1, 2, 3, 11, 15, 6, 7
            ),
            b[3], 0, 1, 2, 3, 4, 5, 11, 15
        ),
        0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15
    );
};
#endif
