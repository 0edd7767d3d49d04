// Pixels of two rows, `a` and `b`, as a vector's planes `v`: for each channel the numbers of both rows, by turns.
//
// A channel is picked out of a row's vectors one after the other: SHUFFLED takes two of them and the places in both.

#define LISTED(...) __VA_ARGS__
#define SHUFFLED(a, b, places) __builtin_shufflevector(a, b, LISTED places)
#define BY_TURNS(a, b) __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15)

#if CHANNELS == 1
auto planes_of = [](const H* a, const H* b, V* v) { v[0] = BY_TURNS(a[0], b[0]); };
#endif
#if CHANNELS == 3
#define OF_ROW(p, two, three) SHUFFLED(SHUFFLED(p[0], p[1], two), p[2], three)
#define PLANE(two, three) BY_TURNS(OF_ROW(a, two, three), OF_ROW(b, two, three))
auto planes_of = [](const H* a, const H* b, V* v) {
    v[0] = PLANE((0, 3, 6, 9, 12, 15, 6, 7), (0, 1, 2, 3, 4, 5, 10, 13));
    v[1] = PLANE((1, 4, 7, 10, 13, 5, 6, 7), (0, 1, 2, 3, 4, 8, 11, 14));
    v[2] = PLANE((2, 5, 8, 11, 14, 5, 6, 7), (0, 1, 2, 3, 4, 9, 12, 15));
};
#endif
#if CHANNELS == 4
#define OF_ROW(p, two, three, four) SHUFFLED(SHUFFLED(SHUFFLED(p[0], p[1], two), p[2], three), p[3], four)
#define PLANE(two, three, four) BY_TURNS(OF_ROW(a, two, three, four), OF_ROW(b, two, three, four))
auto planes_of = [](const H* a, const H* b, V* v) {
    v[0] = PLANE((0, 4, 8, 12, 4, 5, 6, 7), (0, 1, 2, 3, 8, 12, 6, 7), (0, 1, 2, 3, 4, 5, 8, 12));
    v[1] = PLANE((1, 5, 9, 13, 4, 5, 6, 7), (0, 1, 2, 3, 9, 13, 6, 7), (0, 1, 2, 3, 4, 5, 9, 13));
    v[2] = PLANE((2, 6, 10, 14, 4, 5, 6, 7), (0, 1, 2, 3, 10, 14, 6, 7), (0, 1, 2, 3, 4, 5, 10, 14));
    v[3] = PLANE((3, 7, 11, 15, 4, 5, 6, 7), (0, 1, 2, 3, 11, 15, 6, 7), (0, 1, 2, 3, 4, 5, 11, 15));
};
#endif
