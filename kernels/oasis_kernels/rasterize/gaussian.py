"""One Gaussian seen by one camera: the float64 functions that projection and its adjoint share.

Everything per Gaussian is computed in float64, whatever the arrays hold: it is a few hundred operations each, and it
removes the cancellations (needles, far cameras, world offsets) and overflows (huge scales) that float32 has here. What
is computed once a pixel stays in the arrays' own precision; `whitened` is the part of it that all blending shares.
"""

from typing import Any

import warp as wp

from oasis_kernels import constants
from oasis_kernels.runtime.arrays import ONE, TWO, matrix33
from oasis_kernels.runtime.native import defined, header_source

JACOBIAN_LIMIT = wp.constant(wp.float64(constants.JACOBIAN_LIMIT))


@wp.struct
class Splat:
    """A Gaussian in a camera's frame and on its image plane: M M^T + eps2d is the covariance in the image."""

    slope: wp.vec2d  # x/z and y/z, clamped to the widened image
    inside: wp.vec2d  # 1 where `slope` was not clamped, else 0: its derivative
    j0: wp.vec3d  # rows of J, the Jacobian of the perspective projection at `slope`
    j1: wp.vec3d
    b0: wp.vec3d  # rows of B = J R_camera
    b1: wp.vec3d
    m0: wp.vec3d  # rows of M = B F, where F F^T is the covariance in the world
    m1: wp.vec3d


@wp.func
def unit_quaternion(q: wp.vec4d):
    """`q` / |q| and |q|; dividing by the largest component first keeps squares from under- and overflowing."""
    peak = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
    scaled = q / peak
    length = wp.sqrt(wp.dot(scaled, scaled))
    return scaled / length, peak * length


@wp.func
def rotation(q: wp.vec4d) -> wp.mat33d:
    """Rotation matrix of the unit quaternion wxyz."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33d(
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@wp.func
def rotation_adjoint(q: wp.vec4d, g: wp.mat33d) -> wp.vec4d:
    """Gradient by the unit quaternion of sum(g * rotation(q))."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    # The antisymmetric and the symmetric off-diagonal parts of g.
    ax, ay, az = g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]
    sx, sy, sz = g[1, 2] + g[2, 1], g[0, 2] + g[2, 0], g[0, 1] + g[1, 0]
    return TWO * wp.vec4d(
        x * ax + y * ay + z * az,
        w * ax + y * sz + z * sy - TWO * x * (g[1, 1] + g[2, 2]),
        w * ay + x * sz + z * sx - TWO * y * (g[0, 0] + g[2, 2]),
        w * az + x * sy + y * sx - TWO * z * (g[0, 0] + g[1, 1]),
    )


@wp.func
def clamped_slope(slope: wp.float64, focal: wp.float64, centre: wp.float64, size: wp.float64):
    """`slope` within the image and 0.3 of tan(half the field of view) around it; 1 where it was, else 0."""
    margin = JACOBIAN_LIMIT * wp.float64(0.5) * size / focal
    high = (size - centre) / focal + margin
    low = -(centre / focal) - margin
    inside = wp.where(slope < low or slope > high, wp.float64(0.0), ONE)
    return wp.clamp(slope, low, high), inside


@wp.func
def symmetric_part(covars: wp.array3d(dtype=Any), i: int) -> wp.mat33d:
    """Covariance i, (A + A^T) / 2: what a covariance off by rounding means, and gradients by it are symmetric."""
    a = matrix33(covars, i)
    return wp.float64(0.5) * (a + wp.transpose(a))


@wp.func
def factor(covariance: wp.mat33d) -> wp.mat33d:
    """F with F F^T = `covariance`, by Cholesky with the largest diagonal first.

    The order of the pivots bears matrices without full rank; what rounding has made negative counts as 0.
    """
    f = wp.mat33d()
    rest = covariance
    for column in range(3):
        pivot = int(0)  # noqa: UP018  (a variable to Warp, where 0 would be a constant)
        if rest[1, 1] > rest[0, 0]:
            pivot = 1
        if rest[2, 2] > rest[pivot, pivot]:
            pivot = 2
        diagonal = rest[pivot, pivot]
        if diagonal > wp.float64(0.0):
            v = wp.vec3d(rest[0, pivot], rest[1, pivot], rest[2, pivot]) / wp.sqrt(diagonal)
            rest = rest - wp.outer(v, v)
            for k in range(3):
                f[k, column] = v[k]
                rest[k, pivot] = wp.float64(0.0)
                rest[pivot, k] = wp.float64(0.0)
    return f


@wp.func
def splat(
    point: wp.vec3d, camera: wp.mat33d, f: wp.mat33d, intrinsics: wp.vec4d, size: wp.vec2d, ortho: int
) -> Splat:
    """The Gaussian at `point` (z > 0) with covariance f f^T: EWA splatting (Zwicker et al. 2001, eq. 23 to 31)."""
    s = Splat()
    fx, fy = intrinsics[0], intrinsics[1]
    depth = point[2]
    u, u_inside = clamped_slope(point[0] / depth, fx, intrinsics[2], size[0])
    v, v_inside = clamped_slope(point[1] / depth, fy, intrinsics[3], size[1])
    if ortho != 0:  # J is diag(fx, fy), without slopes
        depth = wp.float64(1.0)
        u, u_inside = wp.float64(0.0), wp.float64(0.0)
        v, v_inside = wp.float64(0.0), wp.float64(0.0)
    s.slope = wp.vec2d(u, v)
    s.inside = wp.vec2d(u_inside, v_inside)
    zero = wp.float64(0.0)
    s.j0 = wp.vec3d(fx / depth, zero, -fx * u / depth)
    s.j1 = wp.vec3d(zero, fy / depth, -fy * v / depth)
    s.b0 = wp.transpose(camera) * s.j0
    s.b1 = wp.transpose(camera) * s.j1
    s.m0 = wp.transpose(f) * s.b0
    s.m1 = wp.transpose(f) * s.b1
    return s


@wp.func
def determinant(m0: wp.vec3d, m1: wp.vec3d, eps2d: wp.float64) -> wp.float64:
    """det(M M^T + eps2d) by Cauchy-Binet: a sum of terms >= 0, where a c - b^2 cancels for needles."""
    normal = wp.cross(m0, m1)
    return wp.dot(normal, normal) + eps2d * (wp.dot(m0, m0) + wp.dot(m1, m1)) + eps2d * eps2d


@wp.func
def whitening(covariance: wp.vec3d, det: wp.float64) -> wp.vec4d:
    """Rows of W with W^T W = inverse covariance (xx, xy, yy): its Cholesky factor, pivoted on the larger diagonal.

    sigma(d) = |W d|^2 / 2 is a sum of squares: unlike the quadratic form of the inverse it neither cancels nor turns
    negative.
    """
    xx, xy, yy = covariance[0], covariance[1], covariance[2]
    zero = wp.float64(0.0)
    if xx >= yy:
        k = wp.sqrt(xx / det)
        return wp.vec4d(ONE / wp.sqrt(xx), zero, -k * xy / xx, k)
    k = wp.sqrt(yy / det)
    return wp.vec4d(zero, ONE / wp.sqrt(yy), k, -k * xy / yy)


@wp.func
def whitened(w: Any, dx: Any, dy: Any):
    """W (dx, dy): the offset from the centre in standard deviations."""
    return w[0] * dx + w[1] * dy, w[2] * dx + w[3] * dy


@wp.func_native(
    "#if defined(__CUDA_ARCH__)\n    return ::expf(x);\n#else\n"
    + defined({"VECTOR": "float", "INTEGERS": "int"}, header_source("rasterize/exponential.h"))
    + "    return exponential(x);\n#endif\n"
)
def falloff(x: wp.float32) -> wp.float32: ...


@wp.func_native("return ::exp(x);")
def falloff(x: wp.float64) -> wp.float64: ...  # noqa: F811
