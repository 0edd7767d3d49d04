"""Linear blend skinning of points and of their covariances.

`skin` and `skin_backward`: one thread per point. Blended with the point's weights, the transforms (G_j | t_j) give

    mean'       = G mean + t          (G | t) = sum_j w_j (G_j | t_j)
    covariance' = H covariance H^T    H = G, or the rotation nearest to G

The nearest rotation maximises tr(R^T G): its quaternion is the eigenvector of the largest eigenvalue of Davenport's
4 x 4 matrix K (Horn 1987), found by squaring K + c 1 until nothing else is left; a mirroring G has one too. With
P = R^T G, a change of G rotates R by omega, (tr(P) 1 - P) omega = axial(R^T dG - dG^T R); where the two smallest
stretches cancel, the rotation jumps and has no gradient.

Backward writes the gradient of each point's blended transform as a row of 4 x 4: columns G_0, G_1, G_2, t, each with a
zero below. Arithmetic is float64 whatever the arrays hold.
"""

from typing import Any

import warp as wp

from oasis_kernels.rasterize.gaussian import rotation
from oasis_kernels.runtime.arrays import ZERO, matrix33, put3, put33, row3

wp.set_module_options({"enable_backward": False})

SQUARINGS = wp.constant(40)
"""Enough for eigenvalues that differ by 1e-11 of their size."""
RANK_ONE = wp.constant(wp.float64(1.0 - 1e-15))
"""Norm of the square of a matrix of norm 1 from which it has one eigenvalue and no other."""
SINGULAR = wp.constant(wp.float64(1e-12))


@wp.struct
class Blend:
    """A blended transform."""

    linear: wp.mat33d
    shift: wp.vec3d


@wp.func
def blend(i: int, weights: wp.array2d[Any], transforms: wp.array3d[Any]) -> Blend:
    out = Blend()
    for j in range(transforms.shape[0]):
        w = wp.float64(weights[i, j])
        for r in range(3):
            for c in range(3):
                out.linear[r, c] += w * wp.float64(transforms[j, r, c])
            out.shift[r] += w * wp.float64(transforms[j, r, 3])
    return out


@wp.func
def nearest_rotation(g: wp.mat33d) -> wp.mat33d:
    k = wp.mat44d(
        g[0, 0] + g[1, 1] + g[2, 2], g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1],
        g[2, 1] - g[1, 2], g[0, 0] - g[1, 1] - g[2, 2], g[0, 1] + g[1, 0], g[0, 2] + g[2, 0],
        g[0, 2] - g[2, 0], g[0, 1] + g[1, 0], g[1, 1] - g[0, 0] - g[2, 2], g[1, 2] + g[2, 1],
        g[1, 0] - g[0, 1], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1], g[2, 2] - g[0, 0] - g[1, 1],
    )  # fmt: skip
    # The norm of K bounds its eigenvalues: none stays negative.
    size = wp.sqrt(wp.ddot(k, k))
    if size == ZERO:
        return wp.identity(n=3, dtype=wp.float64)
    k = k / size + wp.identity(n=4, dtype=wp.float64)
    k = k / wp.sqrt(wp.ddot(k, k))
    for _step in range(SQUARINGS):
        k = k * k
        size = wp.sqrt(wp.ddot(k, k))
        k = k / size
        if size >= RANK_ONE:
            break
    best = wp.int32(0)
    for c in range(1, 4):
        if k[c, c] > k[best, best]:
            best = c
    return rotation(wp.normalize(wp.vec4d(k[0, best], k[1, best], k[2, best], k[3, best])))


@wp.func
def nearest_rotation_gradient(g: wp.mat33d, r: wp.mat33d, grad: wp.mat33d) -> wp.mat33d:
    """Gradient by `g`, given the one by its nearest rotation `r`."""
    stretch = wp.transpose(r) * g
    system = wp.trace(stretch) * wp.identity(n=3, dtype=wp.float64) - stretch
    size = wp.max(wp.abs(wp.trace(stretch)), wp.sqrt(wp.ddot(stretch, stretch)))
    if wp.determinant(system) <= SINGULAR * size * size * size:
        return wp.mat33d()
    a = wp.transpose(r) * grad
    y = wp.inverse(system) * wp.vec3d(a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1])
    return r * wp.skew(y)


@wp.kernel
def skin(
    first: int,
    means: wp.array2d[Any],
    covars: wp.array3d[Any],  # no rows when there are none
    weights: wp.array2d[Any],
    transforms: wp.array3d[Any],
    rotation_only: int,
    out_means: wp.array2d[Any],
    out_covars: wp.array3d[Any],
):
    i = first + wp.tid()
    g = blend(i, weights, transforms)
    put3(out_means, i, g.linear * row3(means, i) + g.shift)
    if covars.shape[0] > 0:
        h = g.linear
        if rotation_only != 0:
            h = nearest_rotation(g.linear)
        put33(out_covars, i, h * matrix33(covars, i) * wp.transpose(h))


@wp.kernel
def skin_backward(
    first: int,
    means: wp.array2d[Any],
    covars: wp.array3d[Any],
    weights: wp.array2d[Any],
    transforms: wp.array3d[Any],
    rotation_only: int,
    grad_out_means: wp.array2d[Any],
    grad_out_covars: wp.array3d[Any],  # no rows when there is no such gradient
    # Each of these has a row per point, or none when it is not wanted.
    grad_means: wp.array2d[Any],
    grad_covars: wp.array3d[Any],
    grad_weights: wp.array2d[Any],
    grad_blends: wp.array2d[Any],
):
    i = first + wp.tid()
    g = blend(i, weights, transforms)
    mean = row3(means, i)
    g_mean = row3(grad_out_means, i)
    by_linear = wp.outer(g_mean, mean)
    if grad_out_covars.shape[0] > 0:
        h = g.linear
        if rotation_only != 0:
            h = nearest_rotation(g.linear)
        covar = matrix33(covars, i)
        g_covar = matrix33(grad_out_covars, i)
        by_h = g_covar * h * wp.transpose(covar) + wp.transpose(g_covar) * h * covar
        if rotation_only != 0:
            by_h = nearest_rotation_gradient(g.linear, h, by_h)
        by_linear += by_h
        if grad_covars.shape[0] > 0:
            put33(grad_covars, i, wp.transpose(h) * g_covar * h)
    if grad_means.shape[0] > 0:
        put3(grad_means, i, wp.transpose(g.linear) * g_mean)
    if grad_weights.shape[0] > 0:
        for j in range(transforms.shape[0]):
            total = ZERO
            for r in range(3):
                for c in range(3):
                    total += by_linear[r, c] * wp.float64(transforms[j, r, c])
                total += g_mean[r] * wp.float64(transforms[j, r, 3])
            grad_weights[i, j] = grad_weights.dtype(total)
    if grad_blends.shape[0] > 0:
        for c in range(4):
            for r in range(3):
                value = g_mean[r]
                if c < 3:
                    value = by_linear[r, c]
                grad_blends[i, 4 * c + r] = grad_blends.dtype(value)
            grad_blends[i, 4 * c + 3] = grad_blends.dtype(ZERO)


for real in (wp.float32, wp.float64):
    inputs = {"means": wp.array2d[real], "weights": wp.array2d[real]}
    inputs |= {"covars": wp.array3d[real], "transforms": wp.array3d[real]}
    wp.overload(skin, inputs | {"out_means": wp.array2d[real], "out_covars": wp.array3d[real]})
    gradients = {f"grad_{name}": kind for name, kind in inputs.items() if name != "transforms"}
    outputs = {"grad_out_means": wp.array2d[real], "grad_out_covars": wp.array3d[real], "grad_blends": wp.array2d[real]}
    wp.overload(skin_backward, inputs | gradients | outputs)
