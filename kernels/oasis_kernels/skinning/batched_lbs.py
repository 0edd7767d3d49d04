"""Linear blend skinning of hands of different people: one thread per vertex and image, whatever the batch."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def batched_lbs(
    first: int,
    rest: wp.array2d[wp.vec3f],
    displacements: wp.array3d[wp.float32],  # [vertex, axis, corrective]
    strengths: wp.array2d[wp.float32],
    normals: wp.array[wp.vec3f],
    rises: wp.array2d[wp.float32],  # [vertex, knuckle], along the normal
    knuckles: wp.array2d[wp.float32],
    weights: wp.array2d[wp.float32],
    rotations: wp.array2d[wp.mat33f],
    shifts: wp.array2d[wp.vec3f],
    out: wp.array2d[wp.vec3f],
):
    i = first + wp.tid()
    n_vertices = rest.shape[1]
    b = i // n_vertices
    v = i - b * n_vertices
    p = wp.vec3f()
    for c in range(displacements.shape[2]):
        s = strengths[b, c]
        p += wp.vec3f(s * displacements[v, 0, c], s * displacements[v, 1, c], s * displacements[v, 2, c])
    rise = wp.float32(0.0)
    for k in range(rises.shape[1]):
        rise += rises[v, k] * knuckles[b, k]
    p = rest[b, v] + p + rise * normals[v]
    total = wp.vec3f()
    for j in range(weights.shape[1]):
        w = weights[v, j]
        if w != 0.0:
            total += w * (rotations[b, j] * p + shifts[b, j])
    out[b, v] = total
