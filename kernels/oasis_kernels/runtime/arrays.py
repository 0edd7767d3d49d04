"""Rows of arrays as float64 vectors, whatever the arrays hold."""

from typing import Any

import warp as wp


@wp.func
def row3(a: wp.array2d[Any], i: int) -> wp.vec3d:
    return wp.vec3d(wp.float64(a[i, 0]), wp.float64(a[i, 1]), wp.float64(a[i, 2]))


@wp.func
def row4(a: wp.array2d[Any], i: int) -> wp.vec4d:
    return wp.vec4d(wp.float64(a[i, 0]), wp.float64(a[i, 1]), wp.float64(a[i, 2]), wp.float64(a[i, 3]))
