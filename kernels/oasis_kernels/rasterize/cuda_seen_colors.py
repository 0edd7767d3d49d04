"""Colours of Gaussians from spherical harmonics on CUDA: `spherical_harmonics.see` and its adjoint over raw pointers.

`see` takes one thread for each camera and Gaussian, its adjoint one for each Gaussian, which goes through the cameras
in order, so that no sum depends on how threads run.
"""

import functools

from oasis_kernels.rasterize import spherical_harmonics as harmonics
from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 128

DIRECTION = """
    // From a camera to a Gaussian, of length 1, or 0 where they meet; returns the length it had. A far camera's centre
    // cancels against the Gaussian's in float32.
    auto direction = [&](int camera, int gaussian, float* d) -> float {
        double r[12];
        for (int e = 0; e < 12; e++) r[e] = poses[16 * (long long)camera + e];
        const double *a = r, *b = r + 4, *c = r + 8;
        double across[3][3];
        for (int e = 0; e < 3; e++) {
            const int f = (e + 1) % 3, g = (e + 2) % 3;
            across[0][e] = b[f] * c[g] - b[g] * c[f];
            across[1][e] = c[f] * a[g] - c[g] * a[f];
            across[2][e] = a[f] * b[g] - a[g] * b[f];
        }
        const double volume = a[0] * across[0][0] + a[1] * across[0][1] + a[2] * across[0][2];
        for (int e = 0; e < 3; e++) {
            const double center = -(a[3] * across[0][e] + b[3] * across[1][e] + c[3] * across[2][e]) / volume;
            d[e] = (float)((double)means[3 * (long long)gaussian + e] - center);
        }
        const float peak = fmaxf(fmaxf(fabsf(d[0]), fabsf(d[1])), fabsf(d[2]));
        if (!(peak > 0.f)) { d[0] = d[1] = d[2] = 0.f; return 0.f; }
        for (int e = 0; e < 3; e++) d[e] /= peak;
        const float length = sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        for (int e = 0; e < 3; e++) d[e] /= length;
        return peak * length;
    };
    auto basis = [](const float* d, float* b) {
        const float x = d[0], y = d[1], z = d[2];
        b[0] = @L0@;
        if (@DEGREE@ > 0) {
            b[1] = -@L1@ * y;
            b[2] = @L1@ * z;
            b[3] = -@L1@ * x;
        }
        if (@DEGREE@ > 1) {
            b[4] = @L2_XY@ * x * y;
            b[5] = -@L2_XY@ * y * z;
            b[6] = @L2_ZZ@ * (3.f * z * z - 1.f);
            b[7] = -@L2_XY@ * x * z;
            b[8] = @L2_XX@ * (x * x - y * y);
        }
        if (@DEGREE@ > 2) {
            b[9] = -@L3_XXX@ * y * (3.f * x * x - y * y);
            b[10] = @L3_XYZ@ * x * y * z;
            b[11] = -@L3_YZZ@ * y * (5.f * z * z - 1.f);
            b[12] = @L3_ZZZ@ * z * (5.f * z * z - 3.f);
            b[13] = -@L3_YZZ@ * x * (5.f * z * z - 1.f);
            b[14] = @L3_XXZ@ * z * (x * x - y * y);
            b[15] = -@L3_XXX@ * x * (x * x - 3.f * y * y);
        }
    };
"""

SEE = DIRECTION + """
    if (thread < total) {
        const int camera = thread / n;
        float d[3], b[16], sum[3] = {0.f, 0.f, 0.f};
        direction(camera, thread - camera * n, d);
        basis(d, b);
        const float* const own = coefficients + (long long)(thread % rows) * 3 * n_harmonics;
        for (int k = 0; k < @COUNT@; k++) for (int e = 0; e < 3; e++) sum[e] += b[k] * own[3 * k + e];
        for (int e = 0; e < 3; e++) {
            const float color = sum[e] + 0.5f;
            colors[3 * (long long)thread + e] = color < 0.f ? 0.f : color;  // NaN stays
        }
    }
"""

SEE_BACKWARD = DIRECTION + """
    auto basis_adjoint = [](const float* d, const float* g, float* out) {
        const float x = d[0], y = d[1], z = d[2];
        out[0] = out[1] = out[2] = 0.f;
        if (@DEGREE@ > 0) {
            out[0] -= @L1@ * g[3];
            out[1] -= @L1@ * g[1];
            out[2] += @L1@ * g[2];
        }
        if (@DEGREE@ > 1) {
            out[0] += @L2_XY@ * (g[4] * y - g[7] * z) + 2.f * @L2_XX@ * g[8] * x;
            out[1] += @L2_XY@ * (g[4] * x - g[5] * z) - 2.f * @L2_XX@ * g[8] * y;
            out[2] += 6.f * @L2_ZZ@ * g[6] * z - @L2_XY@ * (g[5] * y + g[7] * x);
        }
        if (@DEGREE@ > 2) {
            const float xx = x * x, yy = y * y, zz = z * z, ring = 5.f * zz - 1.f, across = 3.f * (xx - yy);
            out[0] += @L3_XYZ@ * g[10] * y * z - @L3_XXX@ * (6.f * g[9] * x * y + g[15] * across)
                - @L3_YZZ@ * g[13] * ring + 2.f * @L3_XXZ@ * g[14] * x * z;
            out[1] += @L3_XYZ@ * g[10] * x * z - @L3_XXX@ * (g[9] * across - 6.f * g[15] * x * y)
                - @L3_YZZ@ * g[11] * ring - 2.f * @L3_XXZ@ * g[14] * y * z;
            out[2] += @L3_XYZ@ * g[10] * x * y - 10.f * @L3_YZZ@ * z * (g[11] * y + g[13] * x)
                + @L3_XXZ@ * g[14] * (xx - yy) + @L3_ZZZ@ * g[12] * (15.f * zz - 3.f);
        }
    };

    if (thread < n) {
        double g_mean[3] = {0.0, 0.0, 0.0};
        for (int camera = 0; camera < n_cameras; camera++) {
            const int i = camera * n + thread, row = i % rows;
            float d[3], b[16], g[3];
            const float norm = direction(camera, thread, d);
            for (int e = 0; e < 3; e++)
                g[e] = colors[3 * (long long)i + e] > 0.f ? g_colors[3 * (long long)i + e] : 0.f;
            const long long at = (long long)row * 3 * n_harmonics;
            if (g_coefficients) {
                float* const to = g_coefficients + at;
                const bool first = row == i;
                basis(d, b);
                for (int k = 0; k < @COUNT@; k++) for (int e = 0; e < 3; e++)
                    to[3 * k + e] = (first ? 0.f : to[3 * k + e]) + b[k] * g[e];
                if (first) for (int k = 3 * @COUNT@; k < 3 * n_harmonics; k++) to[k] = 0.f;
            }
            if (g_means || g_centers) {
                const float* const own = coefficients + at;
                float g_unit[3];
                for (int k = 0; k < @COUNT@; k++)
                    b[k] = own[3 * k] * g[0] + own[3 * k + 1] * g[1] + own[3 * k + 2] * g[2];
                basis_adjoint(d, b, g_unit);
                const float along = g_unit[0] * d[0] + g_unit[1] * d[1] + g_unit[2] * d[2];
                for (int e = 0; e < 3; e++) {
                    const float g_direction = norm > 0.f ? (g_unit[e] - along * d[e]) / norm : 0.f;
                    g_mean[e] += g_direction;
                    if (g_centers) g_centers[3 * (long long)i + e] = -(double)g_direction;
                }
            }
        }
        if (g_means) for (int e = 0; e < 3; e++) g_means[3 * (long long)thread + e] = (float)g_mean[e];
    }
"""

SCENE = {
    "n": "int", "rows": "int", "n_harmonics": "int", "means": "const float*", "coefficients": "const float*",
    "poses": "const float*",
}  # fmt: skip
"""Gaussians, rows of coefficients [rows, n_harmonics, 3] (those of all cameras, or those they share), poses 4 x 4."""


def _written(text: str, degree: int) -> str:
    """C++ for a degree."""
    names = [name for name in vars(harmonics) if name[0] == "L" and name[1].isdigit()]
    values = {name: f"{getattr(harmonics, name)!r}f" for name in names}
    for name, value in {**values, "DEGREE": str(degree), "COUNT": str((degree + 1) ** 2)}.items():
        text = text.replace(f"@{name}@", value)
    return text


@functools.cache
def see(degree: int) -> CudaNative:
    """Kernel: a scene -> colours of its `total` pairs of a camera and a Gaussian."""
    return cuda_native(
        "see_colors", {**SCENE, "total": "int", "colors": "float*"}, _written(SEE, degree), BLOCK
    )


@functools.cache
def see_backward(degree: int) -> CudaNative:
    """Kernel: gradient by the colours -> by means, coefficients and, of each Gaussian, cameras' centres; or null."""
    gradients = {
        "n_cameras": "int", "colors": "const float*", "g_colors": "const float*", "g_means": "float*",
        "g_coefficients": "float*", "g_centers": "double*",
    }  # fmt: skip
    return cuda_native("see_colors_backward", {**SCENE, **gradients}, _written(SEE_BACKWARD, degree), BLOCK)
