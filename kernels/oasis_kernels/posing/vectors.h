typedef float V __attribute__((ext_vector_type(16)));
typedef float VU __attribute__((ext_vector_type(16), aligned(4)));  // tensors have no alignment
typedef float Q __attribute__((ext_vector_type(4)));
typedef float QU __attribute__((ext_vector_type(4), aligned(4)));
typedef float H __attribute__((ext_vector_type(8)));
typedef int I __attribute__((ext_vector_type(16)));
typedef int IU __attribute__((ext_vector_type(16), aligned(4)));
struct V3 {
    V x, y, z;
};
struct V4 {
    V w, x, y, z;
};
const V zero = (V)(0.f), one = (V)(1.f);

auto load = [](const float* p) -> V { return *(const VU*)p; };
auto store = [](float* p, V v) { *(VU*)p = v; };
auto load_row = [](const float* p) -> Q { return *(const QU*)p; };
auto store_row = [](float* p, Q v) { *(QU*)p = v; };
auto root = [](V v) -> V { return __builtin_elementwise_sqrt(v); };
#include "algebra.h"
auto largest = [](V a, V b) -> V { return a > b ? a : b; };
auto smallest = [](V a, V b) -> V { return a < b ? a : b; };
auto magnitude = [](V a) -> V { return __builtin_elementwise_abs(a); };
// The power of two at or below a positive number, and the inverse of a power of two.
auto power_below = [](V a) -> V { return __builtin_bit_cast(V, __builtin_bit_cast(I, a) & (I)(0x7f800000)); };
auto inverse_power = [](V a) -> V { return __builtin_bit_cast(V, (I)(0x7f000000) - __builtin_bit_cast(I, a)); };

// 16 rows of four numbers, given in four groups (rows 0 4 8 12, rows 1 5 9 13, ...), to lanes and back.
auto transpose = [](V a, V b, V c, V d) -> V4 {
    auto low = [](V u, V v) -> V {
        return __builtin_shufflevector(u, v, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
    };
    auto high = [](V u, V v) -> V {
        return __builtin_shufflevector(u, v, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
    };
    const V p = low(a, c), q = low(b, d), r = high(a, c), s = high(b, d);
    return {low(p, q), high(p, q), low(r, s), high(r, s)};
};
auto group = [](Q a, Q b, Q c, Q d) -> V {
    const H ab = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
    const H cd = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7);
    return __builtin_shufflevector(ab, cd, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
};
auto rows = [&](auto row) -> V4 {  // row(lane) -> Q
    return transpose(
        group(row(0), row(4), row(8), row(12)), group(row(1), row(5), row(9), row(13)),
        group(row(2), row(6), row(10), row(14)), group(row(3), row(7), row(11), row(15))
    );
};

// Blocks of `count` <= 16 contiguous items.
auto get = [&](const float* p, int count) -> V {
    if (count == 16) return load(p);
    V v = zero;
    memcpy(&v, p, count * sizeof(float));
    return v;
};
auto put = [&](float* p, int count, V v) {
    if (count == 16)
        store(p, v);
    else
        memcpy(p, &v, count * sizeof(float));
};
auto get3 = [&](const float* from, int count) -> V3 {
    float buffer[48];
    if (count < 16) {
        memset(buffer, 0, sizeof buffer);
        memcpy(buffer, from, 3 * count * sizeof(float));
        from = buffer;
    }
    const V p = load(from), q = load(from + 16), r = load(from + 32);
    return {
        __builtin_shufflevector(
            __builtin_shufflevector(p, q, 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, -1, -1, -1, -1, -1), r, 0, 1, 2, 3, 4,
            5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(p, q, 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, -1, -1, -1, -1, -1), r, 0, 1, 2, 3,
            4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30
        ),
        __builtin_shufflevector(
            __builtin_shufflevector(p, q, 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, -1, -1, -1, -1, -1, -1), r, 0, 1, 2, 3,
            4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31
        )
    };
};
auto put3 = [&](float* to, int count, V3 v) {
    const V x = v.x, y = v.y, z = v.z;
    float buffer[48];
    float* out = count < 16 ? buffer : to;
    store(
        out, __builtin_shufflevector(
                 __builtin_shufflevector(x, y, 0, 16, -1, 1, 17, -1, 2, 18, -1, 3, 19, -1, 4, 20, -1, 5), z, 0, 1, 16,
                 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15
             )
    );
    store(
        out + 16, __builtin_shufflevector(
                      __builtin_shufflevector(x, y, 21, -1, 6, 22, -1, 7, 23, -1, 8, 24, -1, 9, 25, -1, 10, 26), z, 0,
                      21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15
                  )
    );
    store(
        out + 32, __builtin_shufflevector(
                      __builtin_shufflevector(x, y, -1, 11, 27, -1, 12, 28, -1, 13, 29, -1, 14, 30, -1, 15, 31, -1), z,
                      26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31
                  )
    );
    if (count < 16) memcpy(to, buffer, 3 * count * sizeof(float));
};
auto get4 = [&](const float* from, int count) -> V4 {
    float buffer[64];
    if (count < 16) {
        memset(buffer, 0, sizeof buffer);
        memcpy(buffer, from, 4 * count * sizeof(float));
        from = buffer;
    }
    return rows([&](int lane) -> Q { return load_row(from + 4 * lane); });
};
auto put4 = [&](float* to, int count, V4 v, int stride = 4) {  // one row every `stride` numbers
    const V4 g = transpose(v.w, v.x, v.y, v.z);
    const V part[4] = {g.w, g.x, g.y, g.z};
    float buffer[64];
    float* out = count < 16 ? buffer : to;
    const int step = count < 16 ? 4 : stride;
#pragma clang loop unroll(full)
    for (int k = 0; k < 4; k++) {
        store_row(out + (0 + k) * step, part[k].lo.lo);
        store_row(out + (4 + k) * step, part[k].lo.hi);
        store_row(out + (8 + k) * step, part[k].hi.lo);
        store_row(out + (12 + k) * step, part[k].hi.hi);
    }
    if (count < 16)
        for (int k = 0; k < count; k++) memcpy(to + k * stride, buffer + 4 * k, 4 * sizeof(float));
};

// Rows of three anywhere in a table of `size` rows, read as rows of four: the last one through a copy.
struct Table {
    const float* rows;
    int last;
    Q tail;
};
auto table3 = [&](const float* p, int size) -> Table {
    Table table = {p, size - 1, (Q)(0.f)};
    if (size) memcpy(&table.tail, p + 3ll * table.last, 3 * sizeof(float));
    return table;
};
auto at3 = [&](const Table& t, int i) -> Q { return i == t.last ? t.tail : load_row(t.rows + 3ll * i); };
