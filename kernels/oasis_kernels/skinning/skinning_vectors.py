"""Skinning on the CPU, what `skinning` computes with H = G, in float32 and in float64.

A transform, padded to the columns (G_0, G_1, G_2, t) of four numbers, is one vector of 16: blending four points at once
is one multiply-add a weight. Weights are dense; skipping zeros would cost more in mispredicted branches.

Gradients of the transforms are sums over all points: `sum_blends` adds up blocks of `BLOCK` points, then the blocks, in
an order that knows nothing of threads.
"""

import functools

from oasis_kernels.posing.posing_vectors import RANGES, fused
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

BLOCK = 256

HEAD = RANGES + """
    typedef @T@ T;
    typedef T V __attribute__((ext_vector_type(16)));
    typedef T VU __attribute__((ext_vector_type(16), aligned(sizeof(T))));
    typedef T Q __attribute__((ext_vector_type(4)));
    auto load = [](const T* p) -> V { return *(const VU*)p; };
    auto store = [](T* p, V v) { *(VU*)p = v; };
    auto store3 = [](T* p, Q v) { memcpy(p, &v, 3 * sizeof(T)); };
    auto dot = [](Q a, Q b) -> T { return (a.x * b.x + a.y * b.y) + (a.z * b.z + a.w * b.w); };
"""

BLENDS = """
    T* columns = (T*)malloc((n_joints + 16) * 16 * sizeof(T));  // one transform a row; on to a whole number of 16 rows
    memset(columns, 0, (n_joints + 16) * 16 * sizeof(T));
    for (int j = 0; j < n_joints; j++) for (int r = 0; r < 3; r++) for (int c = 0; c < 4; c++)
        columns[16 * j + 4 * c + r] = transforms[12 * j + 4 * r + c];
"""

POINTS = """
    ranges(state, n, [&](int first, int end) {
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
                store3(out_means + 3 * at, g0 * x[0] + g1 * x[1] + g2 * x[2] + blends[k].hi.hi);
                if (covars) {
                    Q half[3];  // columns of G S
                    for (int c = 0; c < 3; c++) half[c] = g0 * s[c] + g1 * s[3 + c] + g2 * s[6 + c];
                    for (int r = 0; r < 3; r++)
                        store3(out_covars + 9 * at + 3 * r, half[0][r] * g0 + half[1][r] * g1 + half[2][r] * g2);
                }
            }
        }
    });
    free(columns);
"""

ENTRIES = """
    const int width = (n_joints + 15) / 16 * 16;
    T* entries = (T*)malloc(16 * (width + 1) * sizeof(T));  // an entry of all transforms a row
    for (int e = 0; e < 16; e++) for (int j = 0; j < width; j++) entries[e * width + j] = columns[16 * j + e];
"""

BACKWARD = """
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
    });
    free(columns);
    free(entries);
"""

SUM = """
    phase(state, n_blocks, [&](long long b) {
        T* to = sums + b * n_joints * 16;
        memset(to, 0, n_joints * 16 * sizeof(T));
        for (long long i = b * @BLOCK@; i < wp::min((b + 1) * @BLOCK@, n); i++) {
            const V by = load(g_blends + 16 * i);
            for (int j = 0; j < n_joints; j++)
                store(to + 16 * j, load(to + 16 * j) + weights[i * n_joints + j] * by);
        }
    });
    phase(state + @PHASE_WORDS@, n_joints, [&](long long j) {
        V total = (V)(0);
        for (long long b = 0; b < n_blocks; b++) total += load(sums + (b * n_joints + j) * 16);
        for (int r = 0; r < 3; r++) for (int c = 0; c < 4; c++) g_transforms[12 * j + 4 * r + c] = total[4 * c + r];
    });
"""

INPUTS = {
    "n": "long long",
    "n_joints": "int",
    "means": "const T*",  # [N, 3]
    "covars": "const T*",  # [N, 3, 3] or 0
    "weights": "const T*",  # [N, J]
    "transforms": "const T*",  # [J, 3, 4]
    "state": "long long*",  # `STATE` words of zeros
}
STATE = 2 * PHASE_WORDS
"""Words that threads share."""


def _native(name: str, parameters: dict[str, str], body: str, scalar: str) -> Native:
    parameters = {parameter: kind.replace("T*", f"{scalar}*") for parameter, kind in parameters.items()}
    for word, value in {"T": scalar, "BLOCK": BLOCK, "PHASE_WORDS": PHASE_WORDS}.items():
        body = body.replace(f"@{word}@", str(value))
    return native(f"{name}_{scalar}", parameters, fused(body))


@functools.cache
def skin(scalar: str) -> Native:
    """Kernel in "float" or "double"."""
    outputs = {"out_means": "T*", "out_covars": "T*"}  # [N, 3]; [N, 3, 3]
    return _native("skin", INPUTS | outputs, HEAD + BLENDS + POINTS + FORWARD, scalar)


@functools.cache
def skin_backward(scalar: str) -> Native:
    """Kernel in "float" or "double"."""
    gradients = {
        "g_out_means": "const T*",  # these two may be 0
        "g_out_covars": "const T*",
        "g_means": "T*",  # each of these is 0 if not wanted
        "g_covars": "T*",
        "g_weights": "T*",
        "g_blends": "T*",  # [N, 16]: by the blended transform, of four padded columns
    }
    return _native("skin_backward", INPUTS | gradients, HEAD + BLENDS + ENTRIES + POINTS + BACKWARD, scalar)


@functools.cache
def sum_blends(scalar: str) -> Native:
    """Kernel in "float" or "double": gradients of the transforms from those of the blended ones."""
    parameters = {
        "n": "long long",
        "n_joints": "int",
        "n_blocks": "long long",
        "weights": "const T*",  # [N, J]
        "g_blends": "const T*",  # [N, 16]
        "sums": "T*",  # [blocks, J, 16], scratch
        "g_transforms": "T*",  # [J, 3, 4]
        "state": "long long*",  # `STATE` words of zeros
    }
    return _native("sum_blends", parameters, HEAD + SUM, scalar)
