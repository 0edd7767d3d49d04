"""EWA projection of Gaussians into cameras, culling, and the adjoint of it.

Forward: one thread per (camera, Gaussian), flat index `camera * n + gaussian`. Backward: one thread per Gaussian, which
adds its cameras in order, so that no sum depends on scheduling. Arithmetic is float64 (see `gaussian.py`); arrays hold
`scalar`. A point's place in the image is stored as a whole number plus a remainder, because a float32 pixel coordinate
alone is the largest rounding error of the picture.

A Gaussian that is not drawn has radius 0 and an empty box; nothing after the near test divides by its depth.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels import constants
from oasis_kernels.rasterize.gaussian import (
    determinant,
    factor,
    rotation,
    rotation_adjoint,
    splat,
    symmetric_part,
    unit_quaternion,
    whitening,
)
from oasis_kernels.runtime.arrays import matrix33, put33

BOX_SLACK = wp.constant(wp.float64(constants.BOX_SLACK))


@wp.func
def camera_translation(viewmats: wp.array3d(dtype=Any), c: int) -> wp.vec3d:
    return wp.vec3d(wp.float64(viewmats[c, 0, 3]), wp.float64(viewmats[c, 1, 3]), wp.float64(viewmats[c, 2, 3]))


@wp.func
def camera_intrinsics(Ks: wp.array3d(dtype=Any), c: int) -> wp.vec4d:
    """(fx, fy, cx, cy)."""
    return wp.vec4d(
        wp.float64(Ks[c, 0, 0]), wp.float64(Ks[c, 1, 1]), wp.float64(Ks[c, 0, 2]), wp.float64(Ks[c, 1, 2])
    )


@wp.func
def pixel_range(centre: wp.float64, extent: wp.float64, size: int):
    """First and past-the-last pixel whose centre lies within `extent` of `centre`; clamped before it is an integer."""
    half, limit, zero = wp.float64(0.5), wp.float64(size), wp.float64(0.0)
    first = wp.clamp(wp.ceil(centre - extent - half), zero, limit)
    end = wp.clamp(wp.floor(centre + extent - half) + wp.float64(1.0), zero, limit)
    return int(first), int(end)


@functools.cache
def project(scalar: Any) -> Any:
    """Kernel: Gaussians and cameras -> everything that binning and blending read."""
    vec2, vec3, vec4 = (wp.types.vector(length=n, dtype=scalar) for n in (2, 3, 4))

    @wp.kernel(enable_backward=False, module="unique")
    def project(
        first: int,
        n: int,
        means: wp.array(dtype=vec3),
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        covars: wp.array3d(dtype=scalar),  # [n, 3, 3], instead of quats and scales
        with_covars: int,
        opacities: wp.array(dtype=scalar),  # [n]
        viewmats: wp.array3d(dtype=scalar),  # [C, 4, 4]
        Ks: wp.array3d(dtype=scalar),  # [C, 3, 3]
        ortho: int,  # 1: x = fx X + cx, y = fy Y + cy, whatever the depth
        width: int,
        height: int,
        near: wp.float64,
        far: wp.float64,
        eps2d: wp.float64,
        radius_clip: wp.float64,
        alpha_min: wp.float64,
        extent_sigmas: wp.float64,
        means2d: wp.array(dtype=vec2),  # [C * n], as all that follow
        covars2d: wp.array(dtype=wp.vec3d),  # xx, xy, yy, with eps2d
        depths: wp.array(dtype=scalar),
        conics: wp.array(dtype=vec3),  # the inverse of covars2d
        radii: wp.array(dtype=wp.vec2i),
        sort_depths: wp.array(dtype=wp.float64),
        centers: wp.array(dtype=vec4),  # whole x, whole y, remainder x, remainder y
        whitenings: wp.array(dtype=vec4),
        boxes: wp.array(dtype=wp.vec4i),  # pixels x0, y0, x1, y1, past the end
    ):
        index = first + wp.tid()
        c = index // n
        i = index - c * n
        mean = wp.vec3d(means[i])
        camera = matrix33(viewmats, c)
        point = camera * mean + camera_translation(viewmats, c)
        depth = point[2]
        depths[index] = scalar(depth)
        sort_depths[index] = depth
        radii[index] = wp.vec2i(0, 0)
        boxes[index] = wp.vec4i(0, 0, 0, 0)
        means2d[index] = vec2()
        covars2d[index] = wp.vec3d()
        conics[index] = vec3()
        centers[index] = vec4()
        whitenings[index] = vec4()
        opacity = wp.float64(opacities[i])
        # Written so that a NaN, where the caller did not want to be checked, is culled too.
        if not (depth >= near and depth <= far and opacity >= alpha_min):
            return

        f = wp.mat33d()
        if with_covars != 0:
            f = factor(symmetric_part(covars, i))
        else:
            q, _norm = unit_quaternion(wp.vec4d(quats[i]))
            f = rotation(q) * wp.diag(wp.vec3d(scales[i]))
        intrinsics = camera_intrinsics(Ks, c)
        size = wp.vec2d(wp.float64(width), wp.float64(height))
        s = splat(point, camera, f, intrinsics, size, ortho)
        cov = wp.vec3d(wp.dot(s.m0, s.m0) + eps2d, wp.dot(s.m0, s.m1), wp.dot(s.m1, s.m1) + eps2d)
        det = determinant(s.m0, s.m1, eps2d)
        if not (det > wp.float64(0.0)):  # flat in the image, and eps2d is 0
            return

        if ortho != 0:
            depth = wp.float64(1.0)
        x = intrinsics[0] * point[0] / depth + intrinsics[2]
        y = intrinsics[1] * point[1] / depth + intrinsics[3]
        reach = wp.min(extent_sigmas, wp.sqrt(wp.float64(2.0) * wp.log(opacity / alpha_min)))
        extent_x = reach * wp.sqrt(cov[0])
        extent_y = reach * wp.sqrt(cov[2])
        one = wp.float64(1.0)
        radius_x = wp.max(wp.ceil(extent_x), one)
        radius_y = wp.max(wp.ceil(extent_y), one)
        if radius_x <= radius_clip and radius_y <= radius_clip:
            return
        if x + radius_x <= wp.float64(0.0) or x - radius_x >= size[0]:
            return
        if y + radius_y <= wp.float64(0.0) or y - radius_y >= size[1]:
            return

        # An extent of a fraction of a pixel more costs nothing and outweighs the rounding of the blending.
        x0, x1 = pixel_range(x, extent_x * (one + BOX_SLACK) + BOX_SLACK, width)
        y0, y1 = pixel_range(y, extent_y * (one + BOX_SLACK) + BOX_SLACK, height)
        boxes[index] = wp.vec4i(x0, y0, x1, y1)
        largest = wp.float64(2147483647.0)
        radii[index] = wp.vec2i(int(wp.min(radius_x, largest)), int(wp.min(radius_y, largest)))
        means2d[index] = vec2(scalar(x), scalar(y))
        covars2d[index] = cov
        conics[index] = vec3(scalar(cov[2] / det), scalar(-cov[1] / det), scalar(cov[0] / det))
        whole_x, whole_y = scalar(wp.floor(x)), scalar(wp.floor(y))
        centers[index] = vec4(
            whole_x, whole_y, scalar(x - wp.float64(whole_x)), scalar(y - wp.float64(whole_y))
        )
        whitenings[index] = vec4(whitening(cov, det))

    return project


@functools.cache
def project_backward(scalar: Any) -> Any:
    """Kernel: gradients by means2d, covars2d and depths -> by the Gaussians, and what each one adds to the cameras'."""
    vec2, vec3, vec4 = (wp.types.vector(length=n, dtype=scalar) for n in (2, 3, 4))

    @wp.kernel(enable_backward=False, module="unique")
    def project_backward(
        first: int,
        n: int,
        n_cameras: int,
        means: wp.array(dtype=vec3),
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        covars: wp.array3d(dtype=scalar),  # [n, 3, 3], instead of quats and scales
        with_covars: int,
        viewmats: wp.array3d(dtype=scalar),
        Ks: wp.array3d(dtype=scalar),
        ortho: int,
        width: int,
        height: int,
        radii: wp.array(dtype=wp.vec2i),  # [C * n]; 0 where nothing was drawn
        g_means2d: wp.array(dtype=vec2),  # [C * n]
        g_covars2d: wp.array(dtype=wp.vec3d),  # [C * n]
        g_depths: wp.array(dtype=scalar),  # [C * n]
        per_camera: int,  # 1: fill g_cameras
        g_means: wp.array(dtype=vec3),  # [n]
        g_quats: wp.array(dtype=vec4),  # [n], not filled where covars is given
        g_scales: wp.array(dtype=vec3),  # the same
        g_covars: wp.array3d(dtype=scalar),  # [n, 3, 3], filled only there
        g_cameras: wp.array2d(dtype=wp.float64),  # [C * n, 12]: by the upper three rows of viewmats
    ):
        i = first + wp.tid()
        mean = wp.vec3d(means[i])
        f = wp.mat33d()
        covariance = wp.mat33d()
        if with_covars != 0:
            covariance = symmetric_part(covars, i)
        else:
            unit, _norm = unit_quaternion(wp.vec4d(quats[i]))
            f = rotation(unit) * wp.diag(wp.vec3d(scales[i]))
            covariance = f * wp.transpose(f)
        size = wp.vec2d(wp.float64(width), wp.float64(height))
        half, two = wp.float64(0.5), wp.float64(2.0)
        drawn = int(0)  # noqa: UP018  (a variable to Warp, where 0 would be a constant)
        sum_mean = wp.vec3d()
        sum_covariance = wp.mat33d()
        for c in range(n_cameras):
            index = c * n + i
            camera = matrix33(viewmats, c)
            g_point = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(g_depths[index]))
            g_camera = wp.mat33d()
            if radii[index][0] > 0:
                drawn = 1
                point = camera * mean + camera_translation(viewmats, c)
                intrinsics = camera_intrinsics(Ks, c)
                fx, fy = intrinsics[0], intrinsics[1]
                s = splat(point, camera, f, intrinsics, size, ortho)
                g = g_covars2d[index]  # by xy once: half of it belongs to either off-diagonal entry
                row0 = g[0] * s.b0 + half * g[1] * s.b1  # of G B
                row1 = half * g[1] * s.b0 + g[2] * s.b1
                sum_covariance += wp.outer(s.b0, row0) + wp.outer(s.b1, row1)
                g_b0 = two * (covariance * row0)
                g_b1 = two * (covariance * row1)
                g_camera = wp.outer(s.j0, g_b0) + wp.outer(s.j1, g_b1)
                g_j0 = camera * g_b0
                g_j1 = camera * g_b1

                inverse = wp.float64(1.0)
                moving = wp.float64(0.0)  # whether J changes with depth
                if ortho == 0:
                    inverse = wp.float64(1.0) / point[2]
                    moving = wp.float64(1.0)
                u, v = point[0] * inverse, point[1] * inverse
                g_xy = wp.vec2d(g_means2d[index])
                # J depends on the point through 1/z and through its slopes, which stand still where they were clamped.
                g_u = fx * g_xy[0] - s.inside[0] * fx * inverse * g_j0[2]
                g_v = fy * g_xy[1] - s.inside[1] * fy * inverse * g_j1[2]
                g_inverse = fx * (g_j0[0] - s.slope[0] * g_j0[2]) + fy * (g_j1[1] - s.slope[1] * g_j1[2])
                g_point += inverse * wp.vec3d(g_u, g_v, moving * (-g_u * u - g_v * v - inverse * g_inverse))
            sum_mean += wp.transpose(camera) * g_point
            if per_camera != 0:
                # Without a gradient there may be no number either, where the caller did not want to be checked.
                if wp.length_sq(g_point) != wp.float64(0.0):
                    g_camera += wp.outer(g_point, mean)
                for row in range(3):
                    for column in range(3):
                        g_cameras[index, row * 4 + column] = g_camera[row, column]
                    g_cameras[index, row * 4 + 3] = g_point[row]
        g_means[i] = vec3(sum_mean)
        if with_covars != 0:
            put33(g_covars, i, sum_covariance)
        elif drawn == 0:
            g_quats[i] = vec4()
            g_scales[i] = vec3()
        else:
            scale = wp.vec3d(scales[i])
            q, norm = unit_quaternion(wp.vec4d(quats[i]))
            axes = rotation(q)
            g_f = two * (sum_covariance * f)  # f = axes * scale
            g_scales[i] = vec3(
                wp.vec3d(
                    wp.dot(axes[:, 0], g_f[:, 0]), wp.dot(axes[:, 1], g_f[:, 1]), wp.dot(axes[:, 2], g_f[:, 2])
                )
            )
            g_unit = rotation_adjoint(q, g_f * wp.diag(scale))
            g_quats[i] = vec4((g_unit - wp.dot(g_unit, q) * q) / norm)

    return project_backward


@wp.kernel(enable_backward=False)
def sum_blocks(
    first: int, n: int, block: int, values: wp.array2d(dtype=wp.float64), sums: wp.array2d(dtype=wp.float64)
):
    """Sums of `block` consecutive rows of each group of n, in order; one thread a (group, block, column)."""
    task, column = wp.tid()
    task += first
    n_blocks = (n + block - 1) // block
    group = task // n_blocks
    start = (task - group * n_blocks) * block
    total = wp.float64(0.0)
    for k in range(start, wp.min(start + block, n)):
        total += values[group * n + k, column]
    sums[task, column] = total
