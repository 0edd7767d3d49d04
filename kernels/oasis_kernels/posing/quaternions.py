"""Quaternions wxyz in float64."""

import warp as wp

from oasis_kernels.runtime.arrays import ONE, TWO, ZERO


@wp.struct
class Quaternion:
    """Of any norm."""

    unit: wp.vec4d
    norm: wp.float64


@wp.func
def normalized(q: wp.vec4d) -> Quaternion:
    """The identity where `q` is 0."""
    out = Quaternion()
    out.norm = wp.length(q)
    out.unit = wp.vec4d(ONE, ZERO, ZERO, ZERO)
    if out.norm > ZERO:
        out.unit = q / out.norm
    return out


@wp.func
def normalized_gradient(q: Quaternion, g: wp.vec4d) -> wp.vec4d:
    """By the quaternion before it was normalised, given the gradient by the unit one; 0 where it was 0."""
    out = wp.vec4d()
    if q.norm > ZERO:
        out = (g - wp.dot(g, q.unit) * q.unit) / q.norm
    return out


@wp.func
def multiply(a: wp.vec4d, b: wp.vec4d) -> wp.vec4d:
    """Hamilton product."""
    return wp.vec4d(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def conjugate(q: wp.vec4d) -> wp.vec4d:
    return wp.vec4d(q[0], -q[1], -q[2], -q[3])


@wp.func
def rotate(q: wp.vec4d, v: wp.vec3d) -> wp.vec3d:
    """R(q) v for a unit quaternion."""
    u = wp.vec3d(q[1], q[2], q[3])
    t = TWO * wp.cross(u, v)
    return v + q[0] * t + wp.cross(u, t)


@wp.func
def rotate_gradient(q: wp.vec4d, v: wp.vec3d, g: wp.vec3d) -> wp.vec4d:
    """Gradient by `q` of g . rotate(q, v)."""
    u = wp.vec3d(q[1], q[2], q[3])
    by_u = TWO * (q[0] * wp.cross(v, g) + wp.dot(g, u) * v + wp.dot(u, v) * g - TWO * wp.dot(g, v) * u)
    return wp.vec4d(TWO * wp.dot(g, wp.cross(u, v)), by_u[0], by_u[1], by_u[2])
