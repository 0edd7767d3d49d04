"""View-dependent colour: real spherical harmonics up to degree 3, and their adjoint.

`evaluate` takes directions, one thread each; `sh_to_rgb` takes Gaussians and cameras, one thread for each pair of them,
and its adjoint one for each Gaussian, which goes through the cameras in order.

The basis is that of 3DGS (Kerbl et al. 2023): orthonormal, with the Condon-Shortley sign, m from -l to l. It is written
as polynomials of the unit direction (x, y, z); directions come in at any length. A degree is a kernel of its own.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 128
"""Threads of a block on CUDA."""

L0 = 0.28209479177387814
"""sqrt(1 / (4 pi))."""
L1 = 0.4886025119029199
"""sqrt(3 / (4 pi))."""
L2_XY = 1.0925484305920792
"""sqrt(15 / (4 pi))."""
L2_ZZ = 0.31539156525252005
"""sqrt(5 / (16 pi))."""
L2_XX = 0.5462742152960396
"""sqrt(15 / (16 pi))."""
L3_XXX = 0.5900435899266435
"""sqrt(35 / (32 pi))."""
L3_XYZ = 2.890611442640554
"""sqrt(105 / (4 pi))."""
L3_YZZ = 0.4570457994644658
"""sqrt(21 / (32 pi))."""
L3_ZZZ = 0.3731763325901154
"""sqrt(7 / (16 pi))."""
L3_XXZ = 1.445305721320277
"""sqrt(105 / (16 pi))."""


@functools.cache
def _basis(scalar: Any, degree: int) -> Any:
    """Function: unit direction -> values of the (degree + 1)^2 harmonics."""
    values = wp.types.vector(length=(degree + 1) ** 2, dtype=scalar)
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @wp.func
    def basis(d: vec3):
        x, y, z = d[0], d[1], d[2]
        b = values()
        b[0] = scalar(L0)
        if wp.static(degree > 0):
            b[1] = scalar(-L1) * y
            b[2] = scalar(L1) * z
            b[3] = scalar(-L1) * x
        if wp.static(degree > 1):
            b[4] = scalar(L2_XY) * x * y
            b[5] = scalar(-L2_XY) * y * z
            b[6] = scalar(L2_ZZ) * (scalar(3.0) * z * z - scalar(1.0))
            b[7] = scalar(-L2_XY) * x * z
            b[8] = scalar(L2_XX) * (x * x - y * y)
        if wp.static(degree > 2):
            b[9] = scalar(-L3_XXX) * y * (scalar(3.0) * x * x - y * y)
            b[10] = scalar(L3_XYZ) * x * y * z
            b[11] = scalar(-L3_YZZ) * y * (scalar(5.0) * z * z - scalar(1.0))
            b[12] = scalar(L3_ZZZ) * z * (scalar(5.0) * z * z - scalar(3.0))
            b[13] = scalar(-L3_YZZ) * x * (scalar(5.0) * z * z - scalar(1.0))
            b[14] = scalar(L3_XXZ) * z * (x * x - y * y)
            b[15] = scalar(-L3_XXX) * x * (x * x - scalar(3.0) * y * y)
        return b

    return basis


@functools.cache
def _basis_adjoint(scalar: Any, degree: int) -> Any:
    """Function: unit direction, gradients by the harmonics -> gradient by x, y, z of those polynomials."""
    values = wp.types.vector(length=(degree + 1) ** 2, dtype=scalar)
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @wp.func
    def basis_adjoint(d: vec3, g: values):
        x, y, z = d[0], d[1], d[2]
        out = vec3()
        if wp.static(degree > 0):
            out += scalar(L1) * vec3(-g[3], -g[1], g[2])
        if wp.static(degree > 1):
            two = scalar(2.0)
            out += scalar(L2_XY) * vec3(g[4] * y - g[7] * z, g[4] * x - g[5] * z, -g[5] * y - g[7] * x)
            out += two * scalar(L2_XX) * g[8] * vec3(x, -y, scalar(0.0))
            out[2] = out[2] + scalar(6.0) * scalar(L2_ZZ) * g[6] * z
        if wp.static(degree > 2):
            three, five, six, ten = scalar(3.0), scalar(5.0), scalar(6.0), scalar(10.0)
            xx, yy, zz = x * x, y * y, z * z
            ring = five * zz - scalar(1.0)
            out += scalar(-L3_XXX) * g[9] * vec3(six * x * y, three * (xx - yy), scalar(0.0))
            out += scalar(L3_XYZ) * g[10] * vec3(y * z, x * z, x * y)
            out += scalar(-L3_YZZ) * g[11] * vec3(scalar(0.0), ring, ten * y * z)
            out += scalar(-L3_YZZ) * g[13] * vec3(ring, scalar(0.0), ten * x * z)
            out += scalar(L3_XXZ) * g[14] * vec3(scalar(2.0) * x * z, scalar(-2.0) * y * z, xx - yy)
            out += scalar(-L3_XXX) * g[15] * vec3(three * (xx - yy), -six * x * y, scalar(0.0))
            out[2] = out[2] + scalar(L3_ZZZ) * g[12] * (scalar(15.0) * zz - three)
        return out

    return basis_adjoint


@functools.cache
def _unit(scalar: Any) -> Any:
    """Function: direction -> unit direction and length, without under- or overflow of squares; zero stays zero."""
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @wp.func
    def unit(d: vec3):
        peak = wp.max(wp.max(wp.abs(d[0]), wp.abs(d[1])), wp.abs(d[2]))
        out, norm = vec3(), scalar(0.0)
        if peak > scalar(0.0):
            scaled = d / peak
            length = wp.length(scaled)
            out, norm = scaled / length, peak * length
        return out, norm

    return unit


@functools.cache
def _sum(scalar: Any, degree: int) -> Any:
    """Function: unit direction, a row of coefficients -> the sum of harmonics."""
    vec3, basis = wp.types.vector(length=3, dtype=scalar), _basis(scalar, degree)

    @wp.func
    def total(d: vec3, coefficients: wp.array2d(dtype=vec3), row: int):
        b = basis(d)
        out = vec3()
        for k in range(wp.static((degree + 1) ** 2)):
            out += b[k] * coefficients[row, k]
        return out

    return total


@functools.cache
def _sum_adjoint(scalar: Any, degree: int) -> Any:
    """Function: the same and the gradient by the sum -> gradient by a direction of length `norm`; 0 for length 0."""
    values = wp.types.vector(length=(degree + 1) ** 2, dtype=scalar)
    vec3, basis_adjoint = wp.types.vector(length=3, dtype=scalar), _basis_adjoint(scalar, degree)

    @wp.func
    def by_direction(d: vec3, norm: scalar, coefficients: wp.array2d(dtype=vec3), row: int, g: vec3):
        by_harmonic = values()
        for k in range(wp.static((degree + 1) ** 2)):
            by_harmonic[k] = wp.dot(coefficients[row, k], g)
        g_unit = basis_adjoint(d, by_harmonic)
        out = vec3()
        if norm > scalar(0.0):
            out = (g_unit - wp.dot(g_unit, d) * d) / norm
        return out

    return by_direction


@functools.cache
def evaluate(scalar: Any, degree: int) -> Any:
    """Kernel: directions, coefficients -> sums of harmonics."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    total, unit = _sum(scalar, degree), _unit(scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        first: int,
        directions: wp.array(dtype=vec3),
        coefficients: wp.array2d(dtype=vec3),  # may hold more than the degree's
        out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        d, _norm = unit(directions[i])
        out[i] = total(d, coefficients, i)

    return evaluate


@functools.cache
def evaluate_backward(scalar: Any, degree: int) -> Any:
    """Kernel: gradient by the sums -> by directions and by coefficients; either array empty where not wanted."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    basis, by_direction, unit = _basis(scalar, degree), _sum_adjoint(scalar, degree), _unit(scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate_backward(
        first: int,
        directions: wp.array(dtype=vec3),
        coefficients: wp.array2d(dtype=vec3),
        g_out: wp.array(dtype=vec3),
        g_directions: wp.array(dtype=vec3),
        g_coefficients: wp.array2d(dtype=vec3),  # zero on entry
    ):
        i = first + wp.tid()
        d, norm = unit(directions[i])
        g = g_out[i]
        if g_coefficients.shape[0] > 0:
            b = basis(d)
            for k in range(wp.static((degree + 1) ** 2)):
                g_coefficients[i, k] = b[k] * g
        if g_directions.shape[0] > 0:
            g_directions[i] = by_direction(d, norm, coefficients, i, g)

    return evaluate_backward


@wp.func
def camera_center(r0: wp.vec4d, r1: wp.vec4d, r2: wp.vec4d):
    """Where a camera is, whose pose has these rows: minus the inverse of their first columns times the last."""
    a, b, c = wp.vec3d(r0[0], r0[1], r0[2]), wp.vec3d(r1[0], r1[1], r1[2]), wp.vec3d(r2[0], r2[1], r2[2])
    bc, ca, ab = wp.cross(b, c), wp.cross(c, a), wp.cross(a, b)
    return -(r0[3] * bc + r1[3] * ca + r2[3] * ab) / wp.dot(a, bc)


@functools.cache
def _direction(scalar: Any) -> Any:
    """Function: centre of a Gaussian, rows of a pose -> from the camera to the Gaussian.

    A far camera's centre cancels against the Gaussian's in float32: their difference is taken in float64.
    """
    vec3, vec4 = (wp.types.vector(length=k, dtype=scalar) for k in (3, 4))

    @wp.func
    def direction(mean: vec3, r0: vec4, r1: vec4, r2: vec4):
        center = camera_center(wp.vec4d(r0), wp.vec4d(r1), wp.vec4d(r2))
        return vec3(wp.vec3d(mean) - center)

    return direction


@functools.cache
def sh_to_rgb(scalar: Any, degree: int) -> Any:
    """Kernel: Gaussians, coefficients, poses -> colours max(0, 0.5 + harmonics), as each camera sees them."""
    vec3, vec4 = (wp.types.vector(length=k, dtype=scalar) for k in (3, 4))
    total, unit, direction = _sum(scalar, degree), _unit(scalar), _direction(scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def sh_to_rgb(
        first: int,
        means: wp.array(dtype=vec3),
        coefficients: wp.array2d(dtype=vec3),  # rows of all cameras, one after the other, or those they share
        poses: wp.array2d(dtype=vec4),
        colors: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        n = means.shape[0]
        camera, row = i // n, i % coefficients.shape[0]
        d, _norm = unit(direction(means[i % n], poses[camera, 0], poses[camera, 1], poses[camera, 2]))
        color = total(d, coefficients, row)
        for k in range(3):
            value = color[k] + scalar(0.5)
            color[k] = wp.where(value < scalar(0.0), scalar(0.0), value)  # NaN stays
        colors[i] = color

    return sh_to_rgb


@functools.cache
def sh_to_rgb_backward(scalar: Any, degree: int) -> Any:
    """Kernel: gradient by the colours -> by means, coefficients, and the cameras' centres for each Gaussian.

    An array is empty where it is not wanted.
    """
    vec3, vec4 = (wp.types.vector(length=k, dtype=scalar) for k in (3, 4))
    basis, by_direction, unit = _basis(scalar, degree), _sum_adjoint(scalar, degree), _unit(scalar)
    direction = _direction(scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def sh_to_rgb_backward(
        first: int,
        means: wp.array(dtype=vec3),
        coefficients: wp.array2d(dtype=vec3),
        poses: wp.array2d(dtype=vec4),
        colors: wp.array(dtype=vec3),
        g_colors: wp.array(dtype=vec3),
        g_means: wp.array(dtype=vec3),
        g_coefficients: wp.array2d(dtype=vec3),
        g_centers: wp.array(dtype=wp.vec3d),
    ):
        gaussian = first + wp.tid()
        n = means.shape[0]
        g_mean = wp.vec3d()
        for camera in range(poses.shape[0]):
            i = camera * n + gaussian
            row = i % coefficients.shape[0]
            d, norm = unit(direction(means[gaussian], poses[camera, 0], poses[camera, 1], poses[camera, 2]))
            g = g_colors[i]
            for k in range(3):
                if not colors[i][k] > scalar(0.0):
                    g[k] = scalar(0.0)
            if g_coefficients.shape[0] > 0:
                b = basis(d)
                for k in range(wp.static((degree + 1) ** 2)):
                    if row == i:
                        g_coefficients[row, k] = b[k] * g
                    else:
                        g_coefficients[row, k] += b[k] * g
                if row == i:
                    for k in range(wp.static((degree + 1) ** 2), coefficients.shape[1]):
                        g_coefficients[row, k] = vec3()
            if g_means.shape[0] > 0 or g_centers.shape[0] > 0:
                g_direction = by_direction(d, norm, coefficients, row, g)
                g_mean += wp.vec3d(g_direction)
                if g_centers.shape[0] > 0:
                    g_centers[i] = -wp.vec3d(g_direction)
        if g_means.shape[0] > 0:
            g_means[gaussian] = vec3(g_mean)

    return sh_to_rgb_backward


def _on_cuda(name: str, label: str, degree: int) -> CudaNative:
    numbers = {name: f"{value!r}f" for name, value in globals().items() if name[0] == "L" and name[1].isdigit()}
    constants = {**numbers, "DEGREE": degree, "COUNT": (degree + 1) ** 2}
    return cuda_native("rasterize/spherical_harmonics.cu", name, BLOCK, label=label, constants=constants)


@functools.cache
def cuda_sh_to_rgb(degree: int) -> CudaNative:
    """CUDA kernel in float32: a scene -> colours of its `total` pairs of a camera and a Gaussian."""
    return _on_cuda("sh_to_rgb", "sh_to_rgb", degree)


@functools.cache
def cuda_sh_to_rgb_backward(degree: int) -> CudaNative:
    """CUDA kernel in float32: what `sh_to_rgb_backward` gives; a null pointer for what is not wanted."""
    return _on_cuda("sh_to_rgb_backward", "sh_to_rgb_backward", degree)
