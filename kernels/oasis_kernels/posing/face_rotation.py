"""How each face, and the surface around each vertex, has rotated from the rest mesh to the posed one.

`face_rotations` (one thread per face) -> `vertex_rotations` (one per vertex, over its faces). Backward:
`vertex_rotations_backward` (one per vertex) -> `face_rotations_backward` (one per face; reads its three
vertices, writes a row of nine for its corners) -> `incidence.sum_rows` (corners to vertices).

Face. With the two edges e1, e2 of a corner at rest, e1', e2' posed, and unit normals n, n', the rotation takes n to n'
and is, in the plane, the polar factor of the linear map that takes e1, e2 to e1', e2': the nearest rotation, the same
whichever corner comes first. In frames (t, b, n) with t along e1, written e1 = (l, 0), e2 = (x, y), its angle is
phi = atan2(l' x - l x', l' y + l y'), and the second argument is positive for any two proper triangles.

Vertex. The mean of the faces' quaternions, weighted with the areas at rest, each with the sign that brings it nearest
to the face of the largest area, normalised. Every term then has a positive part along that face's quaternion, so the
sum cannot cancel. Its area ratio is that of all its faces together.

Arithmetic is float64 whatever the arrays hold: it costs scalar code nothing, and lets meshes be of any size.
"""

from typing import Any

import warp as wp

from oasis_kernels.posing.quaternions import conjugate, rotate
from oasis_kernels.runtime.arrays import HALF, ONE, TWO, ZERO, put4, put_corners, row3, row4

wp.set_module_options({"enable_backward": False})

FLAT = wp.constant(wp.float64(1e-6))
"""A triangle with |e1 x e2| up to this share of its longest edge squared has no plane worth the name."""
DAMPING = wp.constant(wp.float64(0.5e-6))
"""Area, as a share of the longest rest edge squared, added to both areas of a ratio: it stays finite for slivers."""


@wp.struct
class Plane:
    """A triangle, seen from one corner."""

    e1: wp.vec3d
    e2: wp.vec3d
    longest: wp.float64  # longest edge, squared
    area: wp.float64
    normal: wp.vec3d  # unit; zero where the triangle is flat
    proper: wp.bool


@wp.func
def plane(f: int, faces: wp.array2d[wp.int32], vertices: wp.array2d[Any]) -> Plane:
    p = row3(vertices, faces[f, 0])
    out = Plane()
    out.e1 = row3(vertices, faces[f, 1]) - p
    out.e2 = row3(vertices, faces[f, 2]) - p
    out.longest = wp.max(wp.max(wp.length_sq(out.e1), wp.length_sq(out.e2)), wp.length_sq(out.e2 - out.e1))
    cross = wp.cross(out.e1, out.e2)
    twice = wp.length(cross)
    out.area = HALF * twice
    out.normal = wp.vec3d(ZERO, ZERO, ZERO)
    out.proper = twice > FLAT * out.longest
    if out.proper:
        out.normal = cross / twice
    return out


@wp.func
def quaternion(m: wp.mat33d) -> wp.vec4d:
    """Unit wxyz quaternion with w >= 0 of a rotation matrix; the largest component is found first (Shepperd 1978)."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    q = wp.vec4d()
    if trace >= wp.max(m[0, 0], wp.max(m[1, 1], m[2, 2])):
        q = wp.vec4d(ONE + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    elif m[0, 0] >= m[1, 1] and m[0, 0] >= m[2, 2]:
        q = wp.vec4d(m[2, 1] - m[1, 2], ONE + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0])
    elif m[1, 1] >= m[2, 2]:
        q = wp.vec4d(m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], ONE - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1])
    else:
        q = wp.vec4d(m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], ONE - m[0, 0] - m[1, 1] + m[2, 2])
    q = q / wp.length(q)
    if q[0] < ZERO:
        return -q
    return q


@wp.func
def rotation_between(rest: Plane, posed: Plane) -> wp.vec4d:
    """Takes the rest plane to the posed one; in the plane, the rotation nearest to the map of the edges."""
    length = wp.length(rest.e1)
    t = rest.e1 / length
    b = wp.cross(rest.normal, t)
    x = wp.dot(rest.e2, t)
    y = wp.dot(rest.e2, b)
    length_posed = wp.length(posed.e1)
    t_posed = posed.e1 / length_posed
    b_posed = wp.cross(posed.normal, t_posed)
    x_posed = wp.dot(posed.e2, t_posed)
    y_posed = wp.dot(posed.e2, b_posed)
    polar = wp.normalize(wp.vec2d(length_posed * y + length * y_posed, length_posed * x - length * x_posed))
    cos = polar[0]
    sin = polar[1]
    t_rotated = cos * t_posed + sin * b_posed
    b_rotated = cos * b_posed - sin * t_posed
    return quaternion(wp.outer(t_rotated, t) + wp.outer(b_rotated, b) + wp.outer(posed.normal, rest.normal))


@wp.func
def damped_ratio(rest: Plane, posed: Plane) -> wp.float64:
    """Posed area over rest area; 1 where the rest triangle is a point."""
    if rest.longest == ZERO:
        return ONE
    damping = DAMPING * rest.longest
    return (posed.area + damping) / (rest.area + damping)


@wp.kernel
def face_rotations(
    first: int,
    rest: wp.array2d[Any],
    posed: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    areas: wp.array2d[wp.float64],  # weight (the rest area, or 0 and the identity); damped rest and posed areas
):
    f = first + wp.tid()
    before = plane(f, faces, rest)
    after = plane(f, faces, posed)
    q = wp.vec4d(ONE, ZERO, ZERO, ZERO)
    weight = ZERO
    if before.proper and after.proper:
        q = rotation_between(before, after)
        weight = before.area
    put4(quats, f, q)
    area_ratio[f] = area_ratio.dtype(damped_ratio(before, after))
    areas[f, 0] = weight
    areas[f, 1] = before.area + DAMPING * before.longest
    areas[f, 2] = after.area + DAMPING * before.longest


@wp.kernel
def vertex_rotations(
    first: int,
    face_quats: wp.array2d[Any],
    areas: wp.array2d[wp.float64],
    offsets: wp.array[wp.int32],  # corners of vertex v are corners[offsets[v] : offsets[v + 1]]
    corners: wp.array[wp.int32],  # 3 face + corner
    fallback: wp.array[wp.int32],  # one face: whose rotation a vertex without a proper face gets
    quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    signs: wp.array[Any],  # for each corner, what its face's quaternion counted with; nothing if not wanted
    sums: wp.array2d[Any],  # length of the sum before it was normalised; rest areas; nothing if not wanted
):
    v = first + wp.tid()
    best = wp.int32(-1)
    largest = ZERO
    rest = ZERO
    posed = ZERO
    for j in range(offsets[v], offsets[v + 1]):
        f = corners[j] // 3
        rest += areas[f, 1]
        posed += areas[f, 2]
        if areas[f, 0] > largest:
            largest = areas[f, 0]
            best = f
    norm = ZERO
    q = wp.vec4d(ONE, ZERO, ZERO, ZERO)
    if best >= 0:
        ref = row4(face_quats, best)
        total = wp.vec4d()
        for j in range(offsets[v], offsets[v + 1]):
            f = corners[j] // 3
            q_face = row4(face_quats, f)
            sign = ONE
            if wp.dot(q_face, ref) < ZERO:
                sign = -ONE
            if signs.shape[0] > 0:
                signs[corners[j]] = signs.dtype(sign)
            total += sign * areas[f, 0] * q_face
        norm = wp.length(total)
        q = total / norm
    elif fallback.shape[0] > 0:
        q = row4(face_quats, fallback[0])
    put4(quats, v, q)
    ratio = ONE
    if rest > ZERO:
        ratio = posed / rest
    area_ratio[v] = area_ratio.dtype(ratio)
    if sums.shape[0] > 0:
        sums[0, v] = sums.dtype(norm)
        sums[1, v] = sums.dtype(rest)


@wp.kernel
def vertex_rotations_backward(
    first: int,
    quats: wp.array2d[Any],
    area_ratio: wp.array[Any],
    sums: wp.array2d[Any],
    grad_quats: wp.array2d[Any],
    grad_area_ratio: wp.array[Any],
    grad_sums: wp.array2d[wp.float64],  # by the sum of quaternions before it was normalised, of posed and of rest areas
):
    v = first + wp.tid()
    norm = wp.float64(sums[0, v])
    rest = wp.float64(sums[1, v])
    g_sum = wp.vec4d()
    if norm > ZERO:
        q = row4(quats, v)
        g = row4(grad_quats, v)
        g_sum = (g - wp.dot(g, q) * q) / norm
    for k in range(4):
        grad_sums[v, k] = g_sum[k]
    by_posed = ZERO
    if rest > ZERO:
        by_posed = wp.float64(grad_area_ratio[v]) / rest
    grad_sums[v, 4] = by_posed
    grad_sums[v, 5] = -wp.float64(area_ratio[v]) * by_posed


@wp.struct
class Edges:
    """Gradients with respect to e1 and e2 of a triangle."""

    e1: wp.vec3d
    e2: wp.vec3d


@wp.func
def rotation_gradient(omega: wp.vec3d, tri: Plane, e1: wp.vec3d, e2: wp.vec3d) -> Edges:
    """Gradient with respect to the edges of `tri` of a rotation onto it, given the gradient `omega` by its spin.

    `e1`, `e2` are the other triangle's edges after that rotation. A small change of tri.e1, tri.e2 spins the rotation
    by n x dn + n dphi: dn is what the normal does, dphi the polar angle, (e2 . de1 - e1 . de2) / trace.
    """
    trace = wp.dot(tri.normal, wp.cross(tri.e1, e2) - wp.cross(tri.e2, e1))
    tilt = wp.cross(omega, tri.normal) / (TWO * tri.area)
    spin = wp.dot(omega, tri.normal) / trace
    out = Edges()
    out.e1 = wp.cross(tri.e2, tilt) + spin * e2
    out.e2 = wp.cross(tilt, tri.e1) - spin * e1
    return out


@wp.func
def area_gradient(grad: wp.float64, tri: Plane) -> Edges:
    out = Edges()
    out.e1 = HALF * grad * wp.cross(tri.e2, tri.normal)
    out.e2 = HALF * grad * wp.cross(tri.normal, tri.e1)
    return out


@wp.func
def longest_gradient(grad: wp.float64, tri: Plane) -> Edges:
    out = Edges()
    opposite = tri.e2 - tri.e1
    if wp.length_sq(tri.e1) == tri.longest:
        out.e1 = TWO * grad * tri.e1
    elif wp.length_sq(tri.e2) == tri.longest:
        out.e2 = TWO * grad * tri.e2
    else:
        out.e1 = -TWO * grad * opposite
        out.e2 = TWO * grad * opposite
    return out


@wp.kernel
def face_rotations_backward(
    first: int,
    rest: wp.array2d[Any],
    posed: wp.array2d[Any],
    faces: wp.array2d[wp.int32],
    face_quats: wp.array2d[Any],
    signs: wp.array[Any],
    grad_sums: wp.array2d[wp.float64],
    grad_face_quats: wp.array2d[Any],
    grad_area_ratio: wp.array[Any],
    grad_rest: wp.array2d[Any],  # nine values per face; no rows when not wanted
    grad_posed: wp.array2d[Any],  # nine values per face; no rows when not wanted
):
    f = first + wp.tid()
    before = plane(f, faces, rest)
    after = plane(f, faces, posed)
    before_grad = Edges()
    after_grad = Edges()
    by_posed = ZERO
    by_rest = ZERO
    for k in range(3):
        by_posed += grad_sums[faces[f, k], 4]
        by_rest += grad_sums[faces[f, k], 5]
    if before.longest > ZERO:
        by_ratio = wp.float64(grad_area_ratio[f]) / (before.area + DAMPING * before.longest)
        by_posed += by_ratio
        by_rest -= damped_ratio(before, after) * by_ratio
    by_damping = by_posed + by_rest

    if before.proper and after.proper:
        q = row4(face_quats, f)
        g = row4(grad_face_quats, f)
        for k in range(3):
            v = faces[f, k]
            sign = wp.float64(signs[3 * f + k])
            g_sum = wp.vec4d(grad_sums[v, 0], grad_sums[v, 1], grad_sums[v, 2], grad_sums[v, 3])
            g += sign * before.area * g_sum
            by_rest += sign * wp.dot(g_sum, q)
        # A spin d of the rotation changes its quaternion by (0, d) q / 2.
        g_vector = wp.vec3d(g[1], g[2], g[3])
        q_vector = wp.vec3d(q[1], q[2], q[3])
        omega = HALF * (q[0] * g_vector - g[0] * q_vector - wp.cross(g_vector, q_vector))
        back = conjugate(q)
        after_grad = rotation_gradient(omega, after, rotate(q, before.e1), rotate(q, before.e2))
        before_grad = rotation_gradient(-rotate(back, omega), before, rotate(back, after.e1), rotate(back, after.e2))

    if grad_posed.shape[0] > 0:
        area = area_gradient(by_posed, after)
        put_corners(grad_posed, f, after_grad.e1 + area.e1, after_grad.e2 + area.e2, wp.mat33d())
    if grad_rest.shape[0] > 0:
        area = area_gradient(by_rest, before)
        damping = longest_gradient(DAMPING * by_damping, before)
        e1 = before_grad.e1 + area.e1 + damping.e1
        e2 = before_grad.e2 + area.e2 + damping.e2
        put_corners(grad_rest, f, e1, e2, wp.mat33d())


for real in (wp.float32, wp.float64):
    rows, values = wp.array2d[real], wp.array[real]
    wp.overload(face_rotations, {"rest": rows, "posed": rows, "quats": rows, "area_ratio": values})
    wp.overload(
        vertex_rotations, {"face_quats": rows, "quats": rows, "area_ratio": values, "signs": values, "sums": rows}
    )
    wp.overload(
        vertex_rotations_backward,
        {"quats": rows, "area_ratio": values, "sums": rows, "grad_quats": rows, "grad_area_ratio": values},
    )
    inputs = dict.fromkeys(("rest", "posed", "face_quats", "grad_face_quats", "grad_rest", "grad_posed"), rows)
    wp.overload(face_rotations_backward, inputs | {"signs": values, "grad_area_ratio": values})
