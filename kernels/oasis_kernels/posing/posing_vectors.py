"""What the vectorised CPU kernels of posing share: 16 faces, vertices or Gaussians at once, one in each lane.

Tensors keep their layout: rows of three or four numbers become lanes by shuffles, and the other way round. Partial
blocks of 16 go through a buffer, so nothing outside a tensor is read or written. A pointer of 0 says that a tensor is
not there, or not wanted, or empty.

Multiply-adds fuse where the CPU can (`fused`); no other freedom is given to the compiler.
"""

LANES = 16
TASK = 1024
"""Items a thread takes at a time."""


def _indices(values: list[int]) -> str:
    return ", ".join(map(str, values))


def _deinterleave(axis: int) -> str:
    """Every third of 48 numbers p, q, r, from `axis` on: two shuffles."""
    places = [axis + 3 * lane for lane in range(LANES)]
    first = _indices([place if place < 2 * LANES else -1 for place in places])
    second = _indices([lane if place < 2 * LANES else place - LANES for lane, place in enumerate(places)])
    return f"__builtin_shufflevector(__builtin_shufflevector(p, q, {first}), r, {second})"


def _interleave(part: int) -> str:
    """The `part`-th 16 of the 48 numbers x0 y0 z0 x1 ...: two shuffles."""
    places = [divmod(LANES * part + lane, 3) for lane in range(LANES)]
    first = _indices([-1 if axis == 2 else item + LANES * axis for item, axis in places])
    second = _indices([item + LANES if axis == 2 else lane for lane, (item, axis) in enumerate(places)])
    return f"__builtin_shufflevector(__builtin_shufflevector(x, y, {first}), z, {second})"


RANGES = f"""
    // `phase`, for n items in ranges: range(first, end).
    auto ranges = [&](long long* progress, long long n, auto&& range) {{
        phase(progress, (n + {TASK - 1}) / {TASK}, [&](long long task) {{
            range((int)(task * {TASK}), (int)wp::min(task * {TASK} + {TASK}, n));
        }});
    }};
"""

HEAD = RANGES + f"""
    typedef float V __attribute__((ext_vector_type(16)));
    typedef float VU __attribute__((ext_vector_type(16), aligned(4)));  // tensors have no alignment
    typedef float Q __attribute__((ext_vector_type(4)));
    typedef float QU __attribute__((ext_vector_type(4), aligned(4)));
    typedef float H __attribute__((ext_vector_type(8)));
    typedef int I __attribute__((ext_vector_type(16)));
    typedef int IU __attribute__((ext_vector_type(16), aligned(4)));
    struct V3 {{ V x, y, z; }};
    struct V4 {{ V w, x, y, z; }};
    const V zero = (V)(0.f), one = (V)(1.f);

    auto load = [](const float* p) -> V {{ return *(const VU*)p; }};
    auto store = [](float* p, V v) {{ *(VU*)p = v; }};
    auto load_row = [](const float* p) -> Q {{ return *(const QU*)p; }};
    auto store_row = [](float* p, Q v) {{ *(QU*)p = v; }};
    auto root = [](V v) -> V {{ return __builtin_elementwise_sqrt(v); }};
    auto dot3 = [](V3 a, V3 b) -> V {{ return a.x * b.x + a.y * b.y + a.z * b.z; }};
    auto dot4 = [](V4 a, V4 b) -> V {{ return a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z; }};
    auto cross = [](V3 a, V3 b) -> V3 {{
        return {{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}};
    }};
    auto scaled = [](V s, V3 a) -> V3 {{ return {{s * a.x, s * a.y, s * a.z}}; }};
    auto scaled4 = [](V s, V4 a) -> V4 {{ return {{s * a.w, s * a.x, s * a.y, s * a.z}}; }};
    auto plus = [](V3 a, V3 b) -> V3 {{ return {{a.x + b.x, a.y + b.y, a.z + b.z}}; }};
    auto minus = [](V3 a, V3 b) -> V3 {{ return {{a.x - b.x, a.y - b.y, a.z - b.z}}; }};
    auto plus4 = [](V4 a, V4 b) -> V4 {{ return {{a.w + b.w, a.x + b.x, a.y + b.y, a.z + b.z}}; }};
    auto choose = [](I mask, V3 a, V3 b) -> V3 {{ return {{mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z}}; }};
    auto choose4 = [](I m, V4 a, V4 b) -> V4 {{
        return {{m ? a.w : b.w, m ? a.x : b.x, m ? a.y : b.y, m ? a.z : b.z}};
    }};
    auto largest = [](V a, V b) -> V {{ return a > b ? a : b; }};
    auto magnitude = [](V a) -> V {{ return __builtin_elementwise_abs(a); }};

    // 16 rows of four numbers, given in four groups (rows 0 4 8 12, rows 1 5 9 13, ...), to lanes and back.
    auto transpose = [](V a, V b, V c, V d) -> V4 {{
        auto low = [](V u, V v) -> V {{
            return __builtin_shufflevector(u, v, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
        }};
        auto high = [](V u, V v) -> V {{
            return __builtin_shufflevector(u, v, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
        }};
        const V p = low(a, c), q = low(b, d), r = high(a, c), s = high(b, d);
        return {{low(p, q), high(p, q), low(r, s), high(r, s)}};
    }};
    auto group = [](Q a, Q b, Q c, Q d) -> V {{
        const H ab = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
        const H cd = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7);
        return __builtin_shufflevector(ab, cd, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    }};
    auto rows = [&](auto row) -> V4 {{  // row(lane) -> Q
        return transpose(group(row(0), row(4), row(8), row(12)), group(row(1), row(5), row(9), row(13)),
                         group(row(2), row(6), row(10), row(14)), group(row(3), row(7), row(11), row(15)));
    }};

    // Blocks of `count` <= 16 contiguous items.
    auto get = [&](const float* p, int count) -> V {{
        if (count == 16) return load(p);
        V v = zero;
        memcpy(&v, p, count * sizeof(float));
        return v;
    }};
    auto put = [&](float* p, int count, V v) {{
        if (count == 16) store(p, v);
        else memcpy(p, &v, count * sizeof(float));
    }};
    auto get3 = [&](const float* from, int count) -> V3 {{
        float buffer[48];
        if (count < 16) {{
            memset(buffer, 0, sizeof buffer);
            memcpy(buffer, from, 3 * count * sizeof(float));
            from = buffer;
        }}
        const V p = load(from), q = load(from + 16), r = load(from + 32);
        return {{{_deinterleave(0)}, {_deinterleave(1)}, {_deinterleave(2)}}};
    }};
    auto put3 = [&](float* to, int count, V3 v) {{
        const V x = v.x, y = v.y, z = v.z;
        float buffer[48];
        float* out = count < 16 ? buffer : to;
        store(out, {_interleave(0)});
        store(out + 16, {_interleave(1)});
        store(out + 32, {_interleave(2)});
        if (count < 16) memcpy(to, buffer, 3 * count * sizeof(float));
    }};
    auto get4 = [&](const float* from, int count) -> V4 {{
        float buffer[64];
        if (count < 16) {{
            memset(buffer, 0, sizeof buffer);
            memcpy(buffer, from, 4 * count * sizeof(float));
            from = buffer;
        }}
        return rows([&](int lane) -> Q {{ return load_row(from + 4 * lane); }});
    }};
    auto put4 = [&](float* to, int count, V4 v, int stride = 4) {{  // one row every `stride` numbers
        const V4 g = transpose(v.w, v.x, v.y, v.z);
        const V part[4] = {{g.w, g.x, g.y, g.z}};
        float buffer[64];
        float* out = count < 16 ? buffer : to;
        const int step = count < 16 ? 4 : stride;
        #pragma clang loop unroll(full)
        for (int k = 0; k < 4; k++) {{
            store_row(out + (0 + k) * step, part[k].lo.lo);
            store_row(out + (4 + k) * step, part[k].lo.hi);
            store_row(out + (8 + k) * step, part[k].hi.lo);
            store_row(out + (12 + k) * step, part[k].hi.hi);
        }}
        if (count < 16) for (int k = 0; k < count; k++) memcpy(to + k * stride, buffer + 4 * k, 4 * sizeof(float));
    }};

    // Rows of three anywhere in a table of `size` rows, read as rows of four: the last one through a copy.
    struct Table {{ const float* rows; int last; Q tail; }};
    auto table3 = [&](const float* p, int size) -> Table {{
        Table table = {{p, size - 1, (Q)(0.f)}};
        if (size) memcpy(&table.tail, p + 3ll * table.last, 3 * sizeof(float));
        return table;
    }};
    auto at3 = [&](const Table& t, int i) -> Q {{
        return i == t.last ? t.tail : load_row(t.rows + 3ll * i);
    }};
"""


def fused(body: str) -> str:
    """C++ `body`, its multiply-adds fused where the CPU can."""
    return "{\n    #pragma clang fp contract(fast)\n" + body + "}\n"
