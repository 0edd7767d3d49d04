"""Pose Gaussians that are bound to the faces of a mesh by barycentric coordinates, or to its vertices.

`pose` and `pose_backward`: one thread per Gaussian, first P on vertices, then Q on faces. At barycentrics b_k of
corners v_k that rotated by q_k:

    mean  = sum b_k v_k
    dq    = m / |m|,  m = sum b_k s_k q_k     s_k = +-1 brings q_k nearest to the corner with the largest b_k
    quat  = dq * canonical quat
    scale = canonical scale * r^h             r: area ratio of the face, bounded; h = 1/2 (a length), 1 or 0

With b_k >= 0 the part of m along that corner's rotation is at least the largest b_k: m cannot vanish. On a vertex v
that rotated by q the mean is v + R(q) offset, and dq = q.

Backward writes gradients of the vertices as rows: one for each Gaussian on a vertex, then three for each on a face, one
per corner; `incidence.sum_rows` adds them up.
"""

from typing import Any

import warp as wp

from oasis_kernels.posing.quaternions import (
    Quaternion,
    conjugate,
    multiply,
    normalized,
    normalized_gradient,
    rotate,
    rotate_gradient,
)
from oasis_kernels.runtime.arrays import HALF, ONE, ZERO, put3, put4, row3, row4

wp.set_module_options({"enable_backward": False})

AREA_RATIO_LIMIT = wp.constant(wp.float64(1e4))
"""Area ratios act on scales within this and its inverse: beyond, a face has collapsed or the mesh is torn."""


@wp.struct
class Mix:
    """The rotation of a place on a face."""

    sum: Quaternion
    signs: wp.vec3d


@wp.func
def aligned_sign(q: wp.vec4d, reference: wp.vec4d) -> wp.float64:
    if wp.dot(q, reference) < ZERO:
        return -ONE
    return ONE


@wp.func
def mix(f: int, faces: wp.array2d[wp.int32], b: wp.vec3d, vertex_quats: wp.array2d[Any]) -> Mix:
    q0 = row4(vertex_quats, faces[f, 0])
    q1 = row4(vertex_quats, faces[f, 1])
    q2 = row4(vertex_quats, faces[f, 2])
    reference = q0
    if b[1] > b[0] and b[1] >= b[2]:
        reference = q1
    elif b[2] > b[0]:
        reference = q2
    out = Mix()
    out.signs = wp.vec3d(aligned_sign(q0, reference), aligned_sign(q1, reference), aligned_sign(q2, reference))
    out.sum = normalized(b[0] * out.signs[0] * q0 + b[1] * out.signs[1] * q1 + b[2] * out.signs[2] * q2)
    if out.sum.norm == ZERO:
        out.sum.unit = reference
    return out


@wp.func
def growth(ratio: wp.float64, half_powers: int) -> wp.float64:
    """ratio^(half_powers / 2), the ratio bounded."""
    r = wp.clamp(ratio, ONE / AREA_RATIO_LIMIT, AREA_RATIO_LIMIT)
    if half_powers == 0:
        return ONE
    if half_powers == 1:
        return wp.sqrt(r)
    return r


@wp.func
def growth_slope(ratio: wp.float64, half_powers: int) -> wp.float64:
    if ratio < ONE / AREA_RATIO_LIMIT or ratio > AREA_RATIO_LIMIT:
        return ZERO
    return HALF * wp.float64(half_powers) * growth(ratio, half_powers) / ratio


@wp.func
def rotation_at(q: wp.vec4d) -> Quaternion:
    """The rotation of a vertex; the quaternion as it is where it is 0."""
    out = normalized(q)
    if out.norm == ZERO:
        out.unit = q
    return out


@wp.kernel
def pose(
    first: int,
    p: int,
    vertices: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    vertex_index: wp.array[wp.int32],  # [P]
    face_index: wp.array[wp.int32],  # [Q]
    barycentrics: wp.array2d[Any],
    vertex_quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    vertex_area_ratio: wp.array[Any],
    offsets: wp.array2d[Any],
    quats: wp.array2d[Any],  # [P + Q, 4]
    scales: wp.array2d[Any],
    half_powers: int,
    posed_means: wp.array2d[Any],
    posed_quats: wp.array2d[Any],
    posed_scales: wp.array2d[Any],
):
    i = first + wp.tid()
    mean = wp.vec3d()
    rotation = wp.vec4d()
    ratio = ONE
    if i < p:
        v = vertex_index[i]
        rotation = rotation_at(row4(vertex_quats, v)).unit
        mean = row3(vertices, v) + rotate(rotation, row3(offsets, i))
        ratio = wp.float64(vertex_area_ratio[v])
    else:
        f = face_index[i - p]
        b = row3(barycentrics, i - p)
        for k in range(3):
            mean += b[k] * row3(vertices, faces[f, k])
        rotation = mix(f, faces, b, vertex_quats).sum.unit
        ratio = wp.float64(area_ratio[f])
    put3(posed_means, i, mean)
    put4(posed_quats, i, multiply(rotation, row4(quats, i)))
    put3(posed_scales, i, growth(ratio, half_powers) * row3(scales, i))


@wp.kernel
def pose_backward(
    first: int,
    p: int,
    vertices: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    vertex_index: wp.array[wp.int32],
    face_index: wp.array[wp.int32],
    barycentrics: wp.array2d[Any],
    vertex_quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    vertex_area_ratio: wp.array[Any],
    offsets: wp.array2d[Any],
    quats: wp.array2d[Any],
    scales: wp.array2d[Any],
    half_powers: int,
    grad_posed_means: wp.array2d[Any],
    grad_posed_quats: wp.array2d[Any],
    grad_posed_scales: wp.array2d[Any],
    # Each of these has no rows when it is not wanted.
    grad_vertices: wp.array2d[Any],  # [P + 3 Q, 3]
    grad_vertex_quats: wp.array2d[Any],  # [P + 3 Q, 4]
    grad_area_ratio: wp.array2d[Any],  # [Q, 1]
    grad_vertex_area_ratio: wp.array2d[Any],  # [P, 1]
    grad_barycentrics: wp.array2d[Any],  # [Q, 3]
    grad_offsets: wp.array2d[Any],  # [P, 3]
    grad_quats: wp.array2d[Any],  # [P + Q, 4]
    grad_scales: wp.array2d[Any],
):
    i = first + wp.tid()
    g_mean = row3(grad_posed_means, i)
    g_quat = row4(grad_posed_quats, i)
    g_scale = row3(grad_posed_scales, i)
    # The product is linear in either factor, and multiplying by a quaternion is undone by its conjugate.
    g_rotation = multiply(g_quat, conjugate(row4(quats, i)))
    rotation = Quaternion()
    ratio = ONE
    if i < p:
        v = vertex_index[i]
        rotation = rotation_at(row4(vertex_quats, v))
        ratio = wp.float64(vertex_area_ratio[v])
        if grad_vertices.shape[0] > 0:
            put3(grad_vertices, i, g_mean)
        if grad_vertex_quats.shape[0] > 0:
            g_rotation += rotate_gradient(rotation.unit, row3(offsets, i), g_mean)
            put4(grad_vertex_quats, i, normalized_gradient(rotation, g_rotation))
        if grad_offsets.shape[0] > 0:
            put3(grad_offsets, i, rotate(conjugate(rotation.unit), g_mean))
        if grad_vertex_area_ratio.shape[0] > 0:
            slope = growth_slope(ratio, half_powers)
            grad_vertex_area_ratio[i, 0] = grad_vertex_area_ratio.dtype(slope * wp.dot(g_scale, row3(scales, i)))
    else:
        j = i - p
        f = face_index[j]
        b = row3(barycentrics, j)
        m = mix(f, faces, b, vertex_quats)
        rotation = m.sum
        ratio = wp.float64(area_ratio[f])
        g_mix = normalized_gradient(m.sum, g_rotation)
        for k in range(3):
            v = faces[f, k]
            if grad_vertices.shape[0] > 0:
                put3(grad_vertices, p + 3 * j + k, b[k] * g_mean)
            if grad_vertex_quats.shape[0] > 0:
                put4(grad_vertex_quats, p + 3 * j + k, b[k] * m.signs[k] * g_mix)
            if grad_barycentrics.shape[0] > 0:
                g = wp.dot(g_mean, row3(vertices, v)) + m.signs[k] * wp.dot(g_mix, row4(vertex_quats, v))
                grad_barycentrics[j, k] = grad_barycentrics.dtype(g)
        if grad_area_ratio.shape[0] > 0:
            slope = growth_slope(ratio, half_powers)
            grad_area_ratio[j, 0] = grad_area_ratio.dtype(slope * wp.dot(g_scale, row3(scales, i)))
    if grad_quats.shape[0] > 0:
        put4(grad_quats, i, multiply(conjugate(rotation.unit), g_quat))
    if grad_scales.shape[0] > 0:
        put3(grad_scales, i, growth(ratio, half_powers) * g_scale)


RATIOS = ("area_ratio", "vertex_area_ratio")
TABLES = ("vertices", "barycentrics", "vertex_quats", "offsets", "quats", "scales")
OUTPUTS = ("posed_means", "posed_quats", "posed_scales")
GRADIENTS = tuple(f"grad_{name}" for name in (*OUTPUTS, *TABLES, *RATIOS))
for real in (wp.float32, wp.float64):
    inputs = dict.fromkeys(RATIOS, wp.array[real]) | dict.fromkeys(TABLES, wp.array2d[real])
    wp.overload(pose, inputs | dict.fromkeys(OUTPUTS, wp.array2d[real]))
    wp.overload(pose_backward, inputs | dict.fromkeys(GRADIENTS, wp.array2d[real]))
