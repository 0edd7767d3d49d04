"""Skinning on the CPU, what `skinning` computes with H = G, in float32 and in float64.

A transform, padded to the columns (G_0, G_1, G_2, t) of four numbers, is one vector of 16: blending four points at once
is one multiply-add a weight. Weights are dense; skipping zeros would cost more in mispredicted branches.

Gradients of the transforms are sums over all points. `sum_blends` adds up blocks of `BLOCK` points, `add_blocks` the
blocks, in an order that knows nothing of threads.
"""

from typing import Any

from oasis_kernels.posing_vectors import kernel

BLOCK = 256

HEAD = """
    #pragma clang fp contract(fast)
    typedef @T@ T;
    typedef T V __attribute__((ext_vector_type(16)));
    typedef T VU __attribute__((ext_vector_type(16), aligned(sizeof(T))));
    typedef T Q __attribute__((ext_vector_type(4)));
    const long long* block = (const long long*)params;
    auto reals = [&](int k) -> T* { return (T*)block[k]; };
    auto load = [](const T* p) -> V { return *(const VU*)p; };
    auto store = [](T* p, V v) { *(VU*)p = v; };
    auto store3 = [](T* p, Q v) { memcpy(p, &v, 3 * sizeof(T)); };
    auto dot = [](Q a, Q b) -> T { return (a.x * b.x + a.y * b.y) + (a.z * b.z + a.w * b.w); };
"""

BLENDS = """
    const T *means = reals(0), *covars = reals(1), *weights = reals(2), *transforms = reals(3);
    const int n_joints = (int)block[4];
    T* columns = (T*)malloc((n_joints + 16) * 16 * sizeof(T));  // one transform a row; on to a whole number of 16 rows
    memset(columns, 0, (n_joints + 16) * 16 * sizeof(T));
    for (int j = 0; j < n_joints; j++) for (int r = 0; r < 3; r++) for (int c = 0; c < 4; c++)
        columns[16 * j + 4 * c + r] = transforms[12 * j + 4 * r + c];
"""

POINTS = """
    for (int i = first; i < end; i += 4) {
        const int count = wp::min(4, end - i);
        const T* w[4];
        V blends[4];
        for (int k = 0; k < 4; k++) {
            w[k] = weights + (long long)wp::min(i + k, end - 1) * n_joints;
            blends[k] = (V)(0);
        }
        for (int j = 0; j < n_joints; j++) {
            const V transform = load(columns + 16 * j);
            for (int k = 0; k < 4; k++) blends[k] += w[k][j] * transform;
        }
        for (int k = 0; k < count; k++) {
            const long long at = i + k;
            const Q g0 = blends[k].lo.lo, g1 = blends[k].lo.hi, g2 = blends[k].hi.lo;
            const T *x = means + 3 * at, *s = covars + 9 * at;
"""

FORWARD = """
            T *out_means = reals(5), *out_covars = reals(6);
            store3(out_means + 3 * at, g0 * x[0] + g1 * x[1] + g2 * x[2] + blends[k].hi.hi);
            if (covars) {
                Q half[3];  // columns of G S
                for (int c = 0; c < 3; c++) half[c] = g0 * s[c] + g1 * s[3 + c] + g2 * s[6 + c];
                for (int r = 0; r < 3; r++)
                    store3(out_covars + 9 * at + 3 * r, half[0][r] * g0 + half[1][r] * g1 + half[2][r] * g2);
            }
        }
    }
    free(columns);
"""

BACKWARD = """
            const T *g_out_means = reals(5), *g_out_covars = reals(6);
            T *g_means = reals(7), *g_covars = reals(8), *g_weights = reals(9), *g_blends = reals(10);
            Q by_shift = (Q)(0);
            if (g_out_means) memcpy(&by_shift, g_out_means + 3 * at, 3 * sizeof(T));
            Q by0 = by_shift * x[0], by1 = by_shift * x[1], by2 = by_shift * x[2];
            if (g_out_covars) {
                const T* g = g_out_covars + 9 * at;
                Q left[3], right[3];  // columns of g G and of g^T G
                const Q rows[3] = {{g[0], g[1], g[2], 0}, {g[3], g[4], g[5], 0}, {g[6], g[7], g[8], 0}};
                const Q turned[3] = {{g[0], g[3], g[6], 0}, {g[1], g[4], g[7], 0}, {g[2], g[5], g[8], 0}};
                const Q linear[3] = {g0, g1, g2};
                for (int c = 0; c < 3; c++) {
                    left[c] = turned[0] * linear[c].x + turned[1] * linear[c].y + turned[2] * linear[c].z;
                    right[c] = rows[0] * linear[c].x + rows[1] * linear[c].y + rows[2] * linear[c].z;
                }
                // g G S^T + g^T G S
                by0 += left[0] * s[0] + left[1] * s[1] + left[2] * s[2];
                by1 += left[0] * s[3] + left[1] * s[4] + left[2] * s[5];
                by2 += left[0] * s[6] + left[1] * s[7] + left[2] * s[8];
                by0 += right[0] * s[0] + right[1] * s[3] + right[2] * s[6];
                by1 += right[0] * s[1] + right[1] * s[4] + right[2] * s[7];
                by2 += right[0] * s[2] + right[1] * s[5] + right[2] * s[8];
                if (g_covars) for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
                    g_covars[9 * at + 3 * r + c] = dot(linear[r], left[c]);
            }
            if (g_means) {
                g_means[3 * at] = dot(g0, by_shift);
                g_means[3 * at + 1] = dot(g1, by_shift);
                g_means[3 * at + 2] = dot(g2, by_shift);
            }
            const Q by[4] = {by0, by1, by2, by_shift};
            if (g_blends) memcpy(g_blends + 16 * at, by, sizeof by);
            if (g_weights) for (int j = 0; j < n_joints; j += 16) {
                V total = (V)(0);
                for (int c = 0; c < 4; c++) for (int r = 0; r < 3; r++)
                    total += by[c][r] * load(entries + (4 * c + r) * width + j);
                memcpy(g_weights + at * n_joints + j, &total, wp::min(16, n_joints - j) * sizeof(T));
            }
        }
    }
    free(columns);
    free(entries);
"""

ENTRIES = """
    const int width = (n_joints + 15) / 16 * 16;
    T* entries = (T*)malloc(16 * (width + 1) * sizeof(T));  // an entry of all transforms a row
    for (int e = 0; e < 16; e++) for (int j = 0; j < width; j++) entries[e * width + j] = columns[16 * j + e];
"""

SUM_BLENDS = """
    const T *weights = reals(0), *g_blends = reals(1);
    const long long n_joints = block[2], n_points = block[3];
    T* out = reals(4);
    for (int b = first; b < end; b++) {
        T* sums = out + b * n_joints * 16;
        memset(sums, 0, n_joints * 16 * sizeof(T));
        for (long long i = (long long)b * @BLOCK@; i < wp::min((b + 1ll) * @BLOCK@, n_points); i++) {
            const V by = load(g_blends + 16 * i);
            for (int j = 0; j < n_joints; j++)
                store(sums + 16 * j, load(sums + 16 * j) + weights[i * n_joints + j] * by);
        }
    }
"""

ADD_BLOCKS = """
    const T* sums = reals(0);
    const long long n_joints = block[1], n_blocks = block[2];
    T* out = reals(3);
    for (int j = first; j < end; j++) {
        V total = (V)(0);
        for (long long b = 0; b < n_blocks; b++) total += load(sums + (b * n_joints + j) * 16);
        for (int r = 0; r < 3; r++) for (int c = 0; c < 4; c++) out[12 * j + 4 * r + c] = total[4 * c + r];
    }
"""


def _of_type(name: str, body: str, scalar: str) -> Any:
    text = (HEAD + body).replace("@T@", scalar).replace("@BLOCK@", str(BLOCK))
    return kernel(f"skinning_vectors_{scalar}", f"{name}_{scalar}", text, head="")


skin, skin_backward, sum_blends, add_blocks = (
    {scalar: _of_type(name, body, scalar) for scalar in ("float", "double")}
    for name, body in (
        ("skin", BLENDS + POINTS + FORWARD),
        ("skin_backward", BLENDS + ENTRIES + POINTS + BACKWARD),
        ("sum_blends", SUM_BLENDS),
        ("add_blocks", ADD_BLOCKS),
    )
)
