"""Fields over vertices, read at places of the surface. One thread per field and place."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def read(
    values: wp.array3d[Any],  # [field, vertex, column]
    corners: wp.array2d[wp.int32],
    weights: wp.array2d[Any],
    out: wp.array3d[Any],
):
    b, n = wp.tid()
    p = corners[n, 0]
    q = corners[n, 1]
    r = corners[n, 2]
    u = weights[n, 0]
    v = weights[n, 1]
    w = weights[n, 2]
    for c in range(out.shape[2]):
        out[b, n, c] = u * values[b, p, c] + v * values[b, q, c] + w * values[b, r, c]
