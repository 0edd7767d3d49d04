"""Depth buffer of a triangle mesh with face ids, and visibility of points against it.

`camera_points` (one thread per vertex) -> `face_boxes` and `fill_faces` (one per face) -> `interpolate` (one per pixel)
and `visibility` (one per point); backwards, `corner_gradients` (one per point). The first axis of a launch and of all
arrays but the faces is the batch. These kernels serve float64 on CUDA; on the CPU `depth_buffer.cpp` computes the same
face ids faster, and they are its oracle.

A pixel's ray is p(z) = z (u, v, 1) with u = (x - cx) / fx, v = (y - cy) / fy. Sheared along it, a corner (X, Y, Z) in
camera axes lands at (X - u Z, Y - v Z) and the ray at the origin; with 2D cross products w_a = b x c, w_b = c x a,
w_c = a x b of the sheared corners, the ray hits where the three agree in sign. The hit has the barycentrics
w / (w_a + w_b + w_c), perspective correct as they stand. Nothing is divided by a vertex's depth, so a triangle may pass
through the camera's plane and needs no clipping (Olano and Greer, "Triangle scan conversion using 2D homogeneous
coordinates", 1997); the near test is made per pixel.

No ray slips between faces (Woop, Benthin and Wald, "Watertight ray/triangle intersection", 2013): a corner lands at the
same rounded place for each of its faces, rounding never swaps the order of the two products of w, so its sign is right
or it is zero, and zero counts as inside. A fused multiply-add would break that, hence `fuse_fp`, off on both back ends.

Arithmetic is float64 whatever the arrays hold: the products cancel as (distance / edge)^2, and a hand a few metres away
would lose its edges in float32.
"""

from typing import Any

import warp as wp

from oasis_kernels.runtime.arrays import HALF, ONE, ZERO

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BOX_MARGIN = wp.constant(wp.float64(1e-3))
"""Pixels added around a projected triangle, so that rounding of the box never decides about a pixel on an edge."""
EDGE_ON = wp.constant(wp.float64(1e-13))
"""A ray within this sine of the triangle's plane misses it; float64 rounding of a unit normal, with a margin of 500."""


@wp.struct
class Triangle:
    """Corners in camera axes."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d
    flat: wp.float64  # |w_a + w_b + w_c| up to here counts as edge-on


@wp.func
def camera_point(b: int, i: int, points: wp.array3d[Any], viewmats: wp.array3d[Any]) -> wp.vec3d:
    """Point `i` in camera axes."""
    x = wp.float64(points[b, i, 0])
    y = wp.float64(points[b, i, 1])
    z = wp.float64(points[b, i, 2])
    p = wp.vec3d()
    for k in range(3):
        p[k] = (
            wp.float64(viewmats[b, k, 0]) * x
            + wp.float64(viewmats[b, k, 1]) * y
            + wp.float64(viewmats[b, k, 2]) * z
            + wp.float64(viewmats[b, k, 3])
        )
    return p


@wp.func
def pixel_of(p: wp.vec3d, b: int, Ks: wp.array3d[Any]) -> wp.vec2d:
    """Image coordinates of a point in front of the camera [px]."""
    u = wp.float64(Ks[b, 0, 0]) * p[0] / p[2] + wp.float64(Ks[b, 0, 2])
    v = wp.float64(Ks[b, 1, 1]) * p[1] / p[2] + wp.float64(Ks[b, 1, 2])
    return wp.vec2d(u, v)


@wp.func
def pixel_rays(b: int, Ks: wp.array3d[Any]) -> wp.vec4d:
    """Where rays are at depth one: the ray of pixel (x, y) at (r0 + x r2, r1 + y r3)."""
    du = ONE / wp.float64(Ks[b, 0, 0])
    dv = ONE / wp.float64(Ks[b, 1, 1])
    return wp.vec4d((HALF - wp.float64(Ks[b, 0, 2])) * du, (HALF - wp.float64(Ks[b, 1, 2])) * dv, du, dv)


@wp.func
def pixel_ray(x: int, y: int, rays: wp.vec4d) -> wp.vec2d:
    return wp.vec2d(rays[0] + wp.float64(x) * rays[2], rays[1] + wp.float64(y) * rays[3])


@wp.func
def with_edge_on(tri: Triangle) -> Triangle:
    tri.flat = EDGE_ON * wp.length(wp.cross(tri.b - tri.a, tri.c - tri.a))
    return tri


@wp.func
def triangle(b: int, f: int, faces: wp.array2d[wp.int32], vertices: wp.array2d[wp.vec3d]) -> Triangle:
    tri = Triangle()
    tri.a = vertices[b, faces[f, 0]]
    tri.b = vertices[b, faces[f, 1]]
    tri.c = vertices[b, faces[f, 2]]
    return with_edge_on(tri)


@wp.func
def sheared(p: wp.vec3d, ray: wp.vec2d) -> wp.vec2d:
    return wp.vec2d(p[0] - ray[0] * p[2], p[1] - ray[1] * p[2])


@wp.func
def cross2(p: wp.vec2d, q: wp.vec2d) -> wp.float64:
    return p[0] * q[1] - p[1] * q[0]


@wp.func
def edge_functions(tri: Triangle, ray: wp.vec2d) -> wp.vec3d:
    """W of the three corners: barycentrics times their sum, all of one sign inside, edges included; zero for a miss."""
    a = sheared(tri.a, ray)
    b = sheared(tri.b, ray)
    c = sheared(tri.c, ray)
    wa = cross2(b, c)
    wb = cross2(c, a)
    wc = cross2(a, b)
    inside = (wa >= ZERO and wb >= ZERO and wc >= ZERO) or (wa <= ZERO and wb <= ZERO and wc <= ZERO)
    # Inside, the three have one sign: the sum loses nothing.
    if not inside or wp.abs(wa + wb + wc) <= tri.flat:
        return wp.vec3d(ZERO, ZERO, ZERO)
    return wp.vec3d(wa, wb, wc)


@wp.func
def depth_at(tri: Triangle, ray: wp.vec2d) -> wp.float64:
    """Depth of the point that the ray hits; 0 for a miss, which is not beyond any near plane."""
    w = edge_functions(tri, ray)
    total = w[0] + w[1] + w[2]
    if total == ZERO:
        return ZERO
    return (w[0] * tri.a[2] + w[1] * tri.b[2] + w[2] * tri.c[2]) / total


@wp.kernel
def camera_points(points: wp.array3d[Any], viewmats: wp.array3d[Any], out: wp.array2d[wp.vec3d]):
    b, i = wp.tid()
    out[b, i] = camera_point(b, i, points, viewmats)


@wp.kernel
def face_boxes(
    vertices: wp.array2d[wp.vec3d],
    faces: wp.array2d[wp.int32],
    Ks: wp.array3d[Any],
    width: int,
    height: int,
    near: wp.float64,
    boxes: wp.array2d[wp.vec4i],  # first column, last column, first row, last row; empty when first > last
):
    b, f = wp.tid()
    n_near = wp.int32(0)
    for k in range(3):
        if vertices[b, faces[f, k]][2] <= near:
            n_near += 1
    if n_near == 3:
        boxes[b, f] = wp.vec4i(0, -1, 0, -1)
        return
    if n_near > 0:
        # Part of the triangle is nearer than the near plane: its image has no simple bound.
        boxes[b, f] = wp.vec4i(0, width - 1, 0, height - 1)
        return
    p = pixel_of(vertices[b, faces[f, 0]], b, Ks)
    q = pixel_of(vertices[b, faces[f, 1]], b, Ks)
    r = pixel_of(vertices[b, faces[f, 2]], b, Ks)
    low = wp.min(p, wp.min(q, r))
    high = wp.max(p, wp.max(q, r))
    # Clamped as floats: the conversion of a huge float to an integer is undefined.
    w = wp.float64(width)
    h = wp.float64(height)
    x0 = wp.clamp(wp.ceil(low[0] - BOX_MARGIN - HALF), ZERO, w)
    x1 = wp.clamp(wp.floor(high[0] + BOX_MARGIN - HALF), -ONE, w - ONE)
    y0 = wp.clamp(wp.ceil(low[1] - BOX_MARGIN - HALF), ZERO, h)
    y1 = wp.clamp(wp.floor(high[1] + BOX_MARGIN - HALF), -ONE, h - ONE)
    boxes[b, f] = wp.vec4i(int(x0), int(x1), int(y0), int(y1))


@wp.kernel
def fill_faces(
    stage: int,
    vertices: wp.array2d[wp.vec3d],
    faces: wp.array2d[wp.int32],
    boxes: wp.array2d[wp.vec4i],
    Ks: wp.array3d[Any],
    near: wp.float64,
    depth: wp.array3d[wp.float64],  # +inf on entry
    face_ids: wp.array3d[wp.uint32],  # -1 as unsigned on entry: the largest id
):
    """Stage 0 finds the depths, stage 1 the smallest face at that depth.

    Both are minima, so the order of the threads does not matter; both are this one kernel, so that the depths of the
    two stages are the same to the bit.
    """
    b, f = wp.tid()
    box = boxes[b, f]
    if box[0] > box[1] or box[2] > box[3]:
        return
    rays = pixel_rays(b, Ks)
    tri = triangle(b, f, faces, vertices)
    for y in range(box[2], box[3] + 1):
        for x in range(box[0], box[1] + 1):
            z = depth_at(tri, pixel_ray(x, y, rays))
            if z > near:
                if stage == 0:
                    wp.atomic_min(depth, b, y, x, z)
                elif z == depth[b, y, x]:
                    wp.atomic_min(face_ids, b, y, x, wp.uint32(f))


@wp.kernel
def interpolate(
    vertices: wp.array2d[wp.vec3d],
    faces: wp.array2d[wp.int32],
    Ks: wp.array3d[Any],
    face_ids: wp.array3d[wp.int32],
    out: wp.array4d[Any],  # batch, height, width, 3; zero on entry
):
    """Barycentrics of every covered pixel."""
    b, y, x = wp.tid()
    f = face_ids[b, y, x]
    if f >= 0:
        w = edge_functions(triangle(b, f, faces, vertices), pixel_ray(x, y, pixel_rays(b, Ks)))
        total = w[0] + w[1] + w[2]
        for k in range(3):
            out[b, y, x, k] = out.dtype(w[k] / total)


@wp.func
def shows_vertex(
    b: int, x: int, y: int, vertex: int, faces: wp.array2d[wp.int32], face_ids: wp.array3d[wp.int32]
) -> wp.bool:
    """Whether one of the 3 x 3 pixels round (x, y) shows a face with the given corner."""
    for v in range(wp.max(y - 1, 0), wp.min(y + 2, face_ids.shape[1])):
        for u in range(wp.max(x - 1, 0), wp.min(x + 2, face_ids.shape[2])):
            f = face_ids[b, v, u]
            if f >= 0:
                if faces[f, 0] == vertex or faces[f, 1] == vertex or faces[f, 2] == vertex:
                    return True
    return False


@wp.kernel
def visibility(
    points: wp.array3d[Any],
    point_vertices: wp.array[wp.int32],  # empty: no point is known to be a vertex
    faces: wp.array2d[wp.int32],
    viewmats: wp.array3d[Any],
    Ks: wp.array3d[Any],
    near: wp.float64,
    tau: wp.float64,
    margin: wp.float64,
    depth: wp.array3d[wp.float64],
    face_ids: wp.array3d[wp.int32],
    out: wp.array2d[Any],  # zero on entry
    slopes: wp.array2d[Any],  # derivative of `out` with respect to the point's depth; zero on entry, or empty
    pixels: wp.array2d[wp.int32],  # the pixel of points whose score is soft; -1 on entry, or empty
):
    b, i = wp.tid()
    p = camera_point(b, i, points, viewmats)
    if p[2] <= near:
        return
    uv = pixel_of(p, b, Ks)
    inside = (
        uv[0] >= ZERO
        and uv[1] >= ZERO
        and uv[0] < wp.float64(face_ids.shape[2])
        and uv[1] < wp.float64(face_ids.shape[1])
    )
    if not inside:
        return
    x = int(uv[0])
    y = int(uv[1])
    if face_ids[b, y, x] < 0:
        out[b, i] = out.dtype(ONE)
        return
    if point_vertices.shape[0] > 0:
        if point_vertices[i] >= 0:
            if shows_vertex(b, x, y, point_vertices[i], faces, face_ids):
                out[b, i] = out.dtype(ONE)
                return
    # The logistic function as a tanh: it saturates without an overflow.
    t = wp.tanh(HALF * (depth[b, y, x] - p[2] + margin) / tau)
    out[b, i] = out.dtype(HALF + HALF * t)
    if slopes.shape[1] > 0:
        slopes[b, i] = slopes.dtype(-(ONE - t * t) * HALF * HALF / tau)
        pixels[b, i] = y * face_ids.shape[2] + x


@wp.kernel
def corner_gradients(
    grad_visibility: wp.array2d[Any],
    slopes: wp.array2d[Any],
    pixels: wp.array2d[wp.int32],
    face_ids: wp.array3d[wp.int32],
    vertices: wp.array3d[Any],
    faces: wp.array2d[wp.int32],
    viewmats: wp.array3d[Any],
    Ks: wp.array3d[Any],
    rows: wp.array4d[Any],  # batch, point, corner, axis
):
    """What each point's score gives to the corners of the face that the buffer shows in its pixel.

    Along a ray d = (u, v, 1), a plane with normal n through a corner that moves by e with weight w comes nearer or
    goes farther by w (n e) / (n d).
    """
    b, i = wp.tid()
    pixel = pixels[b, i]
    if pixel < 0:
        for k in range(3):
            for axis in range(3):
                rows[b, i, k, axis] = rows.dtype(ZERO)
        return
    x = pixel % face_ids.shape[2]
    y = pixel // face_ids.shape[2]
    f = face_ids[b, y, x]
    tri = Triangle()
    tri.a = camera_point(b, faces[f, 0], vertices, viewmats)
    tri.b = camera_point(b, faces[f, 1], vertices, viewmats)
    tri.c = camera_point(b, faces[f, 2], vertices, viewmats)
    tri = with_edge_on(tri)
    ray = pixel_ray(x, y, pixel_rays(b, Ks))
    w = edge_functions(tri, ray)
    normal = wp.normalize(wp.cross(tri.b - tri.a, tri.c - tri.a))
    # The buffer's depth acts as the point's, with the other sign.
    along = -wp.float64(grad_visibility[b, i]) * wp.float64(slopes[b, i])
    along = along / (wp.dot(normal, wp.vec3d(ray[0], ray[1], ONE)) * (w[0] + w[1] + w[2]))
    for axis in range(3):
        world = ZERO
        for k in range(3):
            world += wp.float64(viewmats[b, k, axis]) * normal[k]
        for k in range(3):
            rows[b, i, k, axis] = rows.dtype(along * w[k] * world)


for real in (wp.float32, wp.float64):
    matrices = {"viewmats": wp.array3d[real], "Ks": wp.array3d[real]}
    values = wp.array2d[real]
    wp.overload(camera_points, {"points": wp.array3d[real], "viewmats": wp.array3d[real]})
    for kernel in (face_boxes, fill_faces):
        wp.overload(kernel, {"Ks": wp.array3d[real]})
    wp.overload(interpolate, {"Ks": wp.array3d[real], "out": wp.array4d[real]})
    wp.overload(visibility, {"points": wp.array3d[real], "out": values, "slopes": values, **matrices})
    wp.overload(
        corner_gradients,
        {
            "grad_visibility": values,
            "slopes": values,
            "vertices": wp.array3d[real],
            "rows": wp.array4d[real],
            **matrices,
        },
    )
