"""Carry Gaussians that are tied to faces by barycentric coordinates, or to vertices, along with a posed mesh.

`pose_on_faces`, `pose_on_vertices` and their backwards: one thread a Gaussian. At barycentrics b_k of corners v_k that
turned by q_k:

    mean  = sum b_k v_k
    dq    = m / |m|,  m = sum b_k s_k q_k     s_k = +-1 turns q_k to the side of the corner with the largest b_k
    quat  = dq * canonical quat
    scale = canonical scale * r^h             r: area ratio of the face, bounded; h = 1/2 (a length), 1 or 0

With b_k >= 0 the part of m along that corner's rotation is at least the largest b_k: m cannot vanish. On a vertex v
that turned by q the mean is v + R(q) offset, and dq = q. Backward writes gradients of the vertices as rows of each
Gaussian; `incidence.sum_rows` adds them up.
"""

from typing import Any

import warp as wp

from oasis_kernels.runtime.arrays import row3, row4

wp.set_module_options({"enable_backward": False})

AREA_RATIO_LIMIT = wp.constant(wp.float64(1e4))
"""Area ratios act on scales within this and its inverse: beyond, a face has collapsed or the mesh is torn."""
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))


@wp.struct
class Mix:
    """The rotation of one Gaussian's place on the mesh."""

    unit: wp.vec4d
    norm: wp.float64  # of the sum before it was normalised; 0 where the sum vanished
    signs: wp.vec3d


@wp.func
def multiply(a: wp.vec4d, b: wp.vec4d) -> wp.vec4d:
    """Hamilton product of wxyz quaternions."""
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
    m = b[0] * out.signs[0] * q0 + b[1] * out.signs[1] * q1 + b[2] * out.signs[2] * q2
    out.norm = wp.length(m)
    out.unit = reference
    if out.norm > ZERO:
        out.unit = m / out.norm
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


@wp.kernel
def pose_on_faces(
    first: int,
    vertices: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    face_index: wp.array[wp.int32],
    barycentrics: wp.array2d[Any],
    vertex_quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    quats: wp.array2d[Any],
    scales: wp.array2d[Any],
    half_powers: int,
    posed_means: wp.array2d[Any],
    posed_quats: wp.array2d[Any],
    posed_scales: wp.array2d[Any],
):
    i = first + wp.tid()
    f = face_index[i]
    b = row3(barycentrics, i)
    mean = wp.vec3d()
    for k in range(3):
        mean += b[k] * row3(vertices, faces[f, k])
    turned = multiply(mix(f, faces, b, vertex_quats).unit, row4(quats, i))
    scale = growth(wp.float64(area_ratio[f]), half_powers) * row3(scales, i)
    for k in range(3):
        posed_means[i, k] = posed_means.dtype(mean[k])
        posed_scales[i, k] = posed_scales.dtype(scale[k])
    for k in range(4):
        posed_quats[i, k] = posed_quats.dtype(turned[k])


@wp.kernel
def pose_on_faces_backward(
    first: int,
    vertices: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    face_index: wp.array[wp.int32],
    barycentrics: wp.array2d[Any],
    vertex_quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    quats: wp.array2d[Any],
    scales: wp.array2d[Any],
    half_powers: int,
    grad_means: wp.array2d[Any],
    grad_turned: wp.array2d[Any],
    grad_grown: wp.array2d[Any],
    # Each of these has a row a Gaussian, or none when it is not wanted.
    grad_vertices: wp.array2d[Any],  # nine values: three a corner
    grad_vertex_quats: wp.array2d[Any],  # twelve values: four a corner
    grad_area_ratio: wp.array2d[Any],  # one value
    grad_barycentrics: wp.array2d[Any],
    grad_quats: wp.array2d[Any],
    grad_scales: wp.array2d[Any],
):
    i = first + wp.tid()
    f = face_index[i]
    b = row3(barycentrics, i)
    g_mean = row3(grad_means, i)
    g_turned = row4(grad_turned, i)
    g_grown = row3(grad_grown, i)
    m = mix(f, faces, b, vertex_quats)
    # The product is linear in either factor, and multiplying by a quaternion is undone by its conjugate.
    g_unit = multiply(g_turned, conjugate(row4(quats, i)))
    g_mix = wp.vec4d()
    if m.norm > ZERO:
        g_mix = (g_unit - wp.dot(g_unit, m.unit) * m.unit) / m.norm
    ratio = wp.float64(area_ratio[f])

    if grad_vertices.shape[0] > 0:
        for k in range(3):
            for d in range(3):
                grad_vertices[i, 3 * k + d] = grad_vertices.dtype(b[k] * g_mean[d])
    if grad_vertex_quats.shape[0] > 0:
        for k in range(3):
            for d in range(4):
                grad_vertex_quats[i, 4 * k + d] = grad_vertex_quats.dtype(b[k] * m.signs[k] * g_mix[d])
    if grad_area_ratio.shape[0] > 0:
        slope = growth_slope(ratio, half_powers)
        grad_area_ratio[i, 0] = grad_area_ratio.dtype(slope * wp.dot(g_grown, row3(scales, i)))
    if grad_barycentrics.shape[0] > 0:
        for k in range(3):
            v = faces[f, k]
            g = wp.dot(g_mean, row3(vertices, v)) + m.signs[k] * wp.dot(g_mix, row4(vertex_quats, v))
            grad_barycentrics[i, k] = grad_barycentrics.dtype(g)
    if grad_quats.shape[0] > 0:
        g_quat = multiply(conjugate(m.unit), g_turned)
        for k in range(4):
            grad_quats[i, k] = grad_quats.dtype(g_quat[k])
    if grad_scales.shape[0] > 0:
        factor = growth(ratio, half_powers)
        for k in range(3):
            grad_scales[i, k] = grad_scales.dtype(factor * g_grown[k])


@wp.func
def turn_of(q: wp.vec4d) -> Mix:
    """The rotation of one vertex as `mix` gives that of a place on a face."""
    out = Mix()
    out.norm = wp.length(q)
    out.unit = q
    if out.norm > ZERO:
        out.unit = q / out.norm
    return out


@wp.func
def rotate(q: wp.vec4d, v: wp.vec3d) -> wp.vec3d:
    """R(q) v for a unit wxyz quaternion."""
    u = wp.vec3d(q[1], q[2], q[3])
    t = TWO * wp.cross(u, v)
    return v + q[0] * t + wp.cross(u, t)


@wp.func
def rotate_gradient(q: wp.vec4d, v: wp.vec3d, g: wp.vec3d) -> wp.vec4d:
    """Gradient by `q` of g . rotate(q, v)."""
    u = wp.vec3d(q[1], q[2], q[3])
    by_u = TWO * (
        q[0] * wp.cross(v, g) + wp.dot(g, u) * v + wp.dot(u, v) * g - TWO * wp.dot(g, v) * u
    )
    return wp.vec4d(TWO * wp.dot(g, wp.cross(u, v)), by_u[0], by_u[1], by_u[2])


@wp.kernel
def pose_on_vertices(
    first: int,
    vertices: wp.array2d[Any],
    vertex_index: wp.array[wp.int32],
    vertex_quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    offsets: wp.array2d[Any],
    quats: wp.array2d[Any],
    scales: wp.array2d[Any],
    half_powers: int,
    posed_means: wp.array2d[Any],
    posed_quats: wp.array2d[Any],
    posed_scales: wp.array2d[Any],
):
    i = first + wp.tid()
    v = vertex_index[i]
    turn = turn_of(row4(vertex_quats, v)).unit
    mean = row3(vertices, v) + rotate(turn, row3(offsets, i))
    turned = multiply(turn, row4(quats, i))
    scale = growth(wp.float64(area_ratio[v]), half_powers) * row3(scales, i)
    for k in range(3):
        posed_means[i, k] = posed_means.dtype(mean[k])
        posed_scales[i, k] = posed_scales.dtype(scale[k])
    for k in range(4):
        posed_quats[i, k] = posed_quats.dtype(turned[k])


@wp.kernel
def pose_on_vertices_backward(
    first: int,
    vertices: wp.array2d[Any],
    vertex_index: wp.array[wp.int32],
    vertex_quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    offsets: wp.array2d[Any],
    quats: wp.array2d[Any],
    scales: wp.array2d[Any],
    half_powers: int,
    grad_means: wp.array2d[Any],
    grad_turned: wp.array2d[Any],
    grad_grown: wp.array2d[Any],
    # Each of these has a row a Gaussian, or none when it is not wanted.
    grad_vertices: wp.array2d[Any],
    grad_vertex_quats: wp.array2d[Any],
    grad_area_ratio: wp.array2d[Any],
    grad_offsets: wp.array2d[Any],
    grad_quats: wp.array2d[Any],
    grad_scales: wp.array2d[Any],
):
    i = first + wp.tid()
    v = vertex_index[i]
    g_mean = row3(grad_means, i)
    g_turned = row4(grad_turned, i)
    g_grown = row3(grad_grown, i)
    turn = turn_of(row4(vertex_quats, v))
    ratio = wp.float64(area_ratio[v])

    if grad_vertices.shape[0] > 0:
        for k in range(3):
            grad_vertices[i, k] = grad_vertices.dtype(g_mean[k])
    if grad_vertex_quats.shape[0] > 0:
        g = multiply(g_turned, conjugate(row4(quats, i))) + rotate_gradient(turn.unit, row3(offsets, i), g_mean)
        g_sum = wp.vec4d()
        if turn.norm > ZERO:
            g_sum = (g - wp.dot(g, turn.unit) * turn.unit) / turn.norm
        for k in range(4):
            grad_vertex_quats[i, k] = grad_vertex_quats.dtype(g_sum[k])
    if grad_area_ratio.shape[0] > 0:
        slope = growth_slope(ratio, half_powers)
        grad_area_ratio[i, 0] = grad_area_ratio.dtype(slope * wp.dot(g_grown, row3(scales, i)))
    if grad_offsets.shape[0] > 0:
        back = rotate(conjugate(turn.unit), g_mean)
        for k in range(3):
            grad_offsets[i, k] = grad_offsets.dtype(back[k])
    if grad_quats.shape[0] > 0:
        g_quat = multiply(conjugate(turn.unit), g_turned)
        for k in range(4):
            grad_quats[i, k] = grad_quats.dtype(g_quat[k])
    if grad_scales.shape[0] > 0:
        factor = growth(ratio, half_powers)
        for k in range(3):
            grad_scales[i, k] = grad_scales.dtype(factor * g_grown[k])


COMMON = ("vertices", "vertex_quats", "quats", "scales")
OUTPUTS = ("posed_means", "posed_quats", "posed_scales")
UPSTREAM = ("grad_means", "grad_turned", "grad_grown", "grad_area_ratio")
for real in (wp.float32, wp.float64):
    ratio = {"area_ratio": wp.array[real]}
    for forward, backward, place in (
        (pose_on_faces, pose_on_faces_backward, "barycentrics"),
        (pose_on_vertices, pose_on_vertices_backward, "offsets"),
    ):
        inputs = (*COMMON, place)
        gradients = (*UPSTREAM, *(f"grad_{name}" for name in inputs))
        wp.overload(forward, ratio | dict.fromkeys((*inputs, *OUTPUTS), wp.array2d[real]))
        wp.overload(backward, ratio | dict.fromkeys((*inputs, *gradients), wp.array2d[real]))
