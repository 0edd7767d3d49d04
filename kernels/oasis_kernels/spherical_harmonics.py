"""View-dependent colour: real spherical harmonics up to degree 3, and their adjoint. One thread a direction.

The basis is that of 3DGS (Kerbl et al. 2023): orthonormal, with the Condon-Shortley sign, m from -l to l. It is written
as polynomials of the unit direction (x, y, z); directions come in at any length. A degree is a kernel of its own.
"""

import functools
from typing import Any

import warp as wp

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
            out[2] = out[2] + scalar(6.0 * L2_ZZ) * g[6] * z
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
def evaluate(scalar: Any, degree: int) -> Any:
    """Kernel: directions, coefficients -> sums of harmonics."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    basis, unit = _basis(scalar, degree), _unit(scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        first: int,
        directions: wp.array(dtype=vec3),
        coefficients: wp.array2d(dtype=vec3),  # may hold more than the degree's
        out: wp.array(dtype=vec3),
    ):
        i = first + wp.tid()
        d, _norm = unit(directions[i])
        b = basis(d)
        total = vec3()
        for k in range(wp.static((degree + 1) ** 2)):
            total += b[k] * coefficients[i, k]
        out[i] = total

    return evaluate


@functools.cache
def evaluate_backward(scalar: Any, degree: int) -> Any:
    """Kernel: gradient by the sums -> by directions and by coefficients; either array empty where not wanted."""
    values = wp.types.vector(length=(degree + 1) ** 2, dtype=scalar)
    vec3 = wp.types.vector(length=3, dtype=scalar)
    basis, basis_adjoint, unit = _basis(scalar, degree), _basis_adjoint(scalar, degree), _unit(scalar)

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
            by_harmonic = values()
            for k in range(wp.static((degree + 1) ** 2)):
                by_harmonic[k] = wp.dot(coefficients[i, k], g)
            g_unit = basis_adjoint(d, by_harmonic)
            g_direction = vec3()
            if norm > scalar(0.0):
                g_direction = (g_unit - wp.dot(g_unit, d) * d) / norm
            g_directions[i] = g_direction

    return evaluate_backward
