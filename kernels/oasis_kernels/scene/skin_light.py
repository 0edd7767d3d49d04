"""Light on the posed vertices: normals and stretch, and how much of the sky each one sees.

`surface_state`: one thread per vertex and image. `sky_transfer`: the same; it compares the vertex with depth buffers of
the mesh, one for each of D directions spread over the sphere. The open sky is known in closed form, so the directions
only sample what is hidden: T = cosine lobe - sum over hidden d of max(0, n . d) Y(d) 4 / D. `smooth`: means over the
faces around a vertex, one thread per channel.
"""

import warp as wp

from oasis_kernels.runtime.arrays import image_row_column
from oasis_kernels.scene.sky import cosine_lobe, harmonics

wp.set_module_options({"enable_backward": False})


@wp.kernel
def surface_state(
    first: int,
    vertices: wp.array2d[wp.vec3f],
    faces: wp.array2d[wp.int32],
    offsets: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    normals: wp.array2d[wp.vec3f],
    areas: wp.array2d[wp.float32],
):
    i = first + wp.tid()
    n_vertices = vertices.shape[1]
    b = i // n_vertices
    v = i - b * n_vertices
    total = wp.vec3f()
    area = wp.float32(0.0)
    for e in range(offsets[v], offsets[v + 1]):
        f = entries[e] // 3
        a = vertices[b, faces[f, 0]]
        cross = wp.cross(vertices[b, faces[f, 1]] - a, vertices[b, faces[f, 2]] - a)
        total += cross
        area += wp.length(cross)
    normals[b, v] = wp.normalize(total)
    areas[b, v] = area


@wp.kernel
def smooth(
    first: int,
    values: wp.array3d[wp.float32],
    faces: wp.array2d[wp.int32],
    offsets: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    out: wp.array3d[wp.float32],
):
    b, v, c = image_row_column(first + wp.tid(), values.shape[1], values.shape[2])
    begin, end = offsets[v], offsets[v + 1]
    total = wp.float32(0.0)
    for e in range(begin, end):
        f = entries[e] // 3
        for k in range(3):
            total += values[b, faces[f, k], c]
    if end == begin:
        total = values[b, v, c] * 3.0
    out[b, v, c] = total * (1.0 / (3.0 * float(wp.max(end - begin, 1))))


@wp.kernel
def sky_transfer(
    first: int,
    vertices: wp.array2d[wp.vec3f],
    normals: wp.array2d[wp.vec3f],
    directions: wp.array[wp.vec3f],  # towards the sky
    views: wp.array2d[wp.mat44f],  # [image, direction]: to the frame of a camera far out that way
    focals: wp.array[wp.float32],  # of each image
    depths: wp.array4d[wp.float32],  # [image, direction, row, column]
    lift: float,  # along the normal, so that the surface does not hide itself
    n_lit: int,  # vertices of each image that are wanted
    out: wp.array3d[wp.float32],
):
    i = first + wp.tid()
    b = i // n_lit
    v = i - b * n_lit
    n = normals[b, v]
    p = vertices[b, v] + lift * n
    lobe = cosine_lobe(n)
    size = depths.shape[2]
    half = 0.5 * float(size)
    weight = 4.0 / float(directions.shape[0])
    seen = wp.float32(1.0)
    for k in range(directions.shape[0]):
        d = directions[k]
        cosine = wp.dot(n, d)
        if cosine > 0.0:
            q = wp.transform_point(views[b, k], p)
            x = int(wp.floor(focals[b] * q[0] / q[2] + half))
            y = int(wp.floor(focals[b] * q[1] / q[2] + half))
            if x >= 0 and x < size and y >= 0 and y < size:
                if depths[b, k, y, x] < q[2] - lift:
                    y9 = harmonics(d)
                    for h in range(9):
                        lobe[h] = lobe[h] - weight * cosine * y9[h]
                    seen -= weight * cosine
    for h in range(9):
        out[b, v, h] = lobe[h]
    out[b, v, 9] = wp.clamp(seen, 0.0, 1.0)
