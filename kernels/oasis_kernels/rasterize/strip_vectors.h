typedef float V __attribute__((ext_vector_type(LANES)));
typedef int I __attribute__((ext_vector_type(LANES)));
typedef float VU __attribute__((ext_vector_type(LANES), aligned(4)));
typedef int IU __attribute__((ext_vector_type(LANES), aligned(4)));
typedef float H __attribute__((ext_vector_type(COLUMNS)));
typedef float HU __attribute__((ext_vector_type(COLUMNS), aligned(4)));
// Copy `columns` of `COLUMNS` elements; a size that the compiler knows is a move, another is a call.
auto copy = [](void* to, const void* from, int columns, int element) {
    if (columns == COLUMNS)
        __builtin_memcpy(to, from, COLUMNS * element);
    else
        memcpy(to, from, columns * element);
};
auto load = [](const float* p) -> V { return *(const VU*)p; };
auto store = [](float* p, V v) { *(VU*)p = v; };
typedef bool B __attribute__((ext_vector_type(LANES)));
auto bits_of = [](I mask) -> long long { return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask, B)); };
auto fma = [](V a, V b, V c) -> V {
#if defined(__FMA__) || defined(__aarch64__)
    return __builtin_elementwise_fma(a, b, c);
#else
    return a * b + c;  // or the C library would be called for every lane
#endif
};
const V column = {0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7};
const V row = {0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1};
// Constants, behind a pointer that the compiler cannot see through: it reads them where they are used, at no cost.
// Known, each would be fetched through an address that takes an instruction of its own to load.
float table[] = {TABLE};
float* volatile hidden = table;
const float* const k = hidden;
auto magic = [&] { return (V)(k[0]); };
auto cut = [&] { return (V)(k[1]); };
auto cap = [&] { return (V)(k[2]); };
auto last = [&] { return (V)(k[3]); };
// 2^x for -126 < x < 128, garbage elsewhere: adding 1.5 * 2^23 rounds x, and leaves the whole number in the low
// bits, from where it is added to the exponent.
auto exp2 = [&](V x) -> V {
    const V whole = x + magic();
    const V f = x - (whole - magic());
    const V r = POLYNOMIAL;
    return __builtin_bit_cast(V, __builtin_bit_cast(I, r) + (__builtin_bit_cast(I, whole) << 23));
};
