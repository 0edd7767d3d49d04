"""Pose Gaussians on the faces of a mesh that rotate and stretch with their faces.

`pose` and `pose_backward`: one thread per Gaussian. With edges e_1, e_2 and unit normal n of its face at rest, primes
when posed, the map of the face and the Gaussian are

    F = [e_1' e_2' n'] [e_1 e_2 n]^-1,    mean = sum b_k v_k',    covariance' = F R(q) diag(s)^2 R(q)^T F^T

F takes lengths along the normal to themselves: a surface has no thickness to change. The inverse has the rows
d_1 = e_2 x n / 2A, d_2 = n x e_1 / 2A and n, so F = e_1' d_1^T + e_2' d_2^T + n' n^T. A face that is flat in either
pose has no such map and leaves covariances alone: F = 1 without gradient.

Backward writes gradients of the three corners as a row of nine per Gaussian; `incidence.sum_rows` adds them up.
"""

from typing import Any

import warp as wp

from oasis_kernels.posing.face_rotation import Edges, Plane, plane
from oasis_kernels.posing.quaternions import normalized, normalized_gradient
from oasis_kernels.rasterize.gaussian import rotation, rotation_adjoint
from oasis_kernels.runtime.arrays import TWO, ZERO, matrix33, put3, put4, put33, put_corners, row3, row4

wp.set_module_options({"enable_backward": False})

@wp.func
def inverse(rest: Plane) -> wp.mat33d:
    """Of the matrix with columns e1, e2, n."""
    d1 = wp.cross(rest.e2, rest.normal) / (TWO * rest.area)
    d2 = wp.cross(rest.normal, rest.e1) / (TWO * rest.area)
    return wp.matrix_from_rows(d1, d2, rest.normal)


@wp.func
def face_map(rest: Plane, posed: Plane) -> wp.mat33d:
    if rest.proper and posed.proper:
        return wp.matrix_from_cols(posed.e1, posed.e2, posed.normal) * inverse(rest)
    return wp.identity(n=3, dtype=wp.float64)


@wp.kernel
def pose(
    first: int,
    rest: wp.array2d[Any],
    posed: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    face_index: wp.array[wp.int32],
    barycentrics: wp.array2d[Any],
    quats: wp.array2d[Any],
    scales: wp.array2d[Any],
    means: wp.array2d[Any],
    covars: wp.array3d[Any],
):
    i = first + wp.tid()
    f = face_index[i]
    mean = wp.vec3d()
    for k in range(3):
        mean += wp.float64(barycentrics[i, k]) * row3(posed, faces[f, k])
    half = face_map(plane(f, faces, rest), plane(f, faces, posed)) * rotation(normalized(row4(quats, i)).unit)
    half = half * wp.diag(row3(scales, i))
    put3(means, i, mean)
    put33(covars, i, half * wp.transpose(half))


@wp.func
def edge_gradient(by_columns: wp.mat33d, of: Plane) -> Edges:
    """Given the gradient by the columns e1, e2, n."""
    by_normal = wp.vec3d(by_columns[0, 2], by_columns[1, 2], by_columns[2, 2])
    by_cross = (by_normal - wp.dot(by_normal, of.normal) * of.normal) / (TWO * of.area)
    out = Edges()
    out.e1 = wp.vec3d(by_columns[0, 0], by_columns[1, 0], by_columns[2, 0]) + wp.cross(of.e2, by_cross)
    out.e2 = wp.vec3d(by_columns[0, 1], by_columns[1, 1], by_columns[2, 1]) + wp.cross(by_cross, of.e1)
    return out


@wp.kernel
def pose_backward(
    first: int,
    rest: wp.array2d[Any],
    posed: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    face_index: wp.array[wp.int32],
    barycentrics: wp.array2d[Any],
    quats: wp.array2d[Any],
    scales: wp.array2d[Any],
    grad_means: wp.array2d[Any],
    grad_covars: wp.array3d[Any],
    # Each of these has a row per Gaussian, or none when it is not wanted.
    grad_rest: wp.array2d[Any],  # nine values: three per corner
    grad_posed: wp.array2d[Any],
    grad_barycentrics: wp.array2d[Any],
    grad_quats: wp.array2d[Any],
    grad_scales: wp.array2d[Any],
):
    i = first + wp.tid()
    f = face_index[i]
    before = plane(f, faces, rest)
    after = plane(f, faces, posed)
    b = row3(barycentrics, i)
    g_mean = row3(grad_means, i)
    g = matrix33(grad_covars, i)
    g = g + wp.transpose(g)
    m = face_map(before, after)
    q = normalized(row4(quats, i))
    axes = rotation(q.unit)
    scale = row3(scales, i)
    half = axes * wp.diag(scale)
    by_half = g * m * half  # of F half
    by_map = by_half * wp.transpose(half)
    by_half = wp.transpose(m) * by_half

    if grad_barycentrics.shape[0] > 0:
        for k in range(3):
            grad_barycentrics[i, k] = grad_barycentrics.dtype(wp.dot(g_mean, row3(posed, faces[f, k])))
    if grad_scales.shape[0] > 0:
        for k in range(3):
            total = ZERO
            for r in range(3):
                total += by_half[r, k] * axes[r, k]
            grad_scales[i, k] = grad_scales.dtype(total)
    if grad_quats.shape[0] > 0:
        put4(grad_quats, i, normalized_gradient(q, rotation_adjoint(q.unit, by_half * wp.diag(scale))))

    of_posed = Edges()
    of_rest = Edges()
    if before.proper and after.proper:
        back = wp.transpose(inverse(before))
        of_posed = edge_gradient(by_map * back, after)
        of_rest = edge_gradient(-wp.transpose(m) * by_map * back, before)
    if grad_posed.shape[0] > 0:
        put_corners(grad_posed, i, of_posed.e1, of_posed.e2, wp.outer(b, g_mean))
    if grad_rest.shape[0] > 0:
        put_corners(grad_rest, i, of_rest.e1, of_rest.e2, wp.mat33d())


for real in (wp.float32, wp.float64):
    rows = wp.array2d[real]
    inputs = dict.fromkeys(("rest", "posed", "barycentrics", "quats", "scales"), rows)
    wp.overload(pose, inputs | {"means": rows, "covars": wp.array3d[real]})
    gradients = {f"grad_{name}": rows for name in (*inputs, "means")}
    wp.overload(pose_backward, inputs | gradients | {"grad_covars": wp.array3d[real]})
