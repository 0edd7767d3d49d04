"""Rows of arrays as float64 vectors, whatever the arrays hold; numbers in float64; places in arrays."""

from typing import Any

import warp as wp

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))


@wp.func
def row3(a: wp.array2d[Any], i: int) -> wp.vec3d:
    return wp.vec3d(wp.float64(a[i, 0]), wp.float64(a[i, 1]), wp.float64(a[i, 2]))


@wp.func
def row4(a: wp.array2d[Any], i: int) -> wp.vec4d:
    return wp.vec4d(wp.float64(a[i, 0]), wp.float64(a[i, 1]), wp.float64(a[i, 2]), wp.float64(a[i, 3]))


@wp.func
def matrix33(a: wp.array3d[Any], i: int) -> wp.mat33d:
    """The upper left 3 x 3 part of matrix `i`."""
    m = wp.mat33d()
    for r in range(3):
        for c in range(3):
            m[r, c] = wp.float64(a[i, r, c])
    return m


@wp.func
def put3(a: wp.array2d[Any], i: int, v: wp.vec3d):
    for k in range(3):
        a[i, k] = a.dtype(v[k])


@wp.func
def put4(a: wp.array2d[Any], i: int, v: wp.vec4d):
    for k in range(4):
        a[i, k] = a.dtype(v[k])


@wp.func
def put33(a: wp.array3d[Any], i: int, m: wp.mat33d):
    for r in range(3):
        for c in range(3):
            a[i, r, c] = a.dtype(m[r, c])


@wp.func
def put_corners(a: wp.array2d[Any], i: int, e1: wp.vec3d, e2: wp.vec3d, corners: wp.mat33d):
    """A row of nine: gradients of the corners of a triangle, rows of `corners`, and those by its two first edges."""
    for k in range(3):
        a[i, k] = a.dtype(corners[0, k] - e1[k] - e2[k])
        a[i, 3 + k] = a.dtype(corners[1, k] + e1[k])
        a[i, 6 + k] = a.dtype(corners[2, k] + e2[k])


@wp.func
def image_row_column(i: int, rows: int, columns: int):
    """Image, row and column of element `i` of a stack of images."""
    image = i // (rows * columns)
    row = (i - image * rows * columns) // columns
    return image, row, i - (image * rows + row) * columns
