"""How much of the light from all around reaches points of a surface that hides it from itself.

One thread per point and image. It asks the depth buffers of the surface, one for each of D directions that are spread
over the sphere, which of them are hidden, and adds up what arrives: sum over d of w_d max(0, n . d) L(d) V(d), over the
same sum without V. V is percentage-closer filtered (Reeves et al. 1987): four texels, bilinear, each with a ramp.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

STEEPEST = wp.constant(3.0)
"""Tangent of the angle between a direction and a point's normal up to which depth may differ by a texel's slope."""
LEAST = wp.constant(1e-6)
"""Light below which nothing arrives, hidden or not."""


@wp.kernel
def sky_exposure(
    first: int,
    points: wp.array2d[wp.vec3f],
    normals: wp.array2d[wp.vec3f],
    directions: wp.array2d[wp.vec3f],  # [image, direction]: towards the sky
    weights: wp.array[wp.float32],
    radiance: wp.array2d[wp.vec3f],  # [image, direction]
    views: wp.array2d[wp.mat44f],  # [image, direction]: to the frame of a camera far out that way
    focal: float,  # of those cameras [px]; their axis is the middle of the buffer
    texels: wp.array[wp.float32],  # size of a texel on the surface of each image [m]
    depths: wp.array4d[wp.float32],  # [image, direction, row, column]
    lift: float,  # along the normal, so that the surface does not hide itself; the ramp is as long
    out: wp.array2d[wp.vec4f],  # under an even sky, then red, green and blue
):
    i = first + wp.tid()
    b = i // points.shape[1]
    v = i - b * points.shape[1]
    n = normals[b, v]
    p = points[b, v] + lift * n
    size = depths.shape[2]
    middle = 0.5 * float(size) - 0.5
    last = size - 1
    whole = wp.vec4f()
    seen = wp.vec4f()
    for k in range(directions.shape[1]):
        d = directions[b, k]
        cosine = wp.dot(n, d)
        if cosine > 0.0:
            light = radiance[b, k]
            arriving = weights[k] * cosine * wp.vec4f(1.0, light[0], light[1], light[2])
            q = wp.transform_point(views[b, k], p)
            steep = wp.min(wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0)) / cosine, STEEPEST)
            bias = lift + steep * texels[b]
            x = focal * q[0] / q[2] + middle
            y = focal * q[1] / q[2] + middle
            left = int(wp.floor(x))
            top = int(wp.floor(y))
            u = x - float(left)
            w = y - float(top)
            share = wp.float32(0.0)
            for corner in range(4):
                column = wp.clamp(left + corner % 2, 0, last)
                row = wp.clamp(top + corner // 2, 0, last)
                weight = wp.where(corner % 2 == 1, u, 1.0 - u) * wp.where(corner // 2 == 1, w, 1.0 - w)
                share += weight * wp.clamp((depths[b, k, row, column] + bias - q[2]) / lift + 1.0, 0.0, 1.0)
            whole += arriving
            seen += share * arriving
    for c in range(4):
        if whole[c] > LEAST:
            seen[c] = wp.min(seen[c] / whole[c], 1.0)
        else:
            seen[c] = 1.0
    out[b, v] = seen
