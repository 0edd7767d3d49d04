"""Patterns on a surface: gradient noise, one thread per point, and the dabs of lines and spots, one thread per dab.

Everything is evaluated at points in space, so that a pattern has no seam where its texture has one. `pixel_noise` draws
normal random numbers for pixels, from a seed an image: the same whatever the batch, the device and the threads.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

REACH = wp.constant(8.0)
"""Square of the widths beyond which a dab is nothing."""
NOISE_GAIN = wp.constant(1.5)
"""Brings gradient noise, which hardly reaches +-0.7, to about [-1, 1]."""


@wp.kernel
def noise(
    first: int,
    points: wp.array[wp.vec3f],
    cells: wp.array[wp.float32],  # size of a cell of each field
    seeds: wp.array[wp.int32],
    octaves: wp.array[wp.int32],  # each half as large and half as strong as the one before
    out: wp.array2d[wp.float32],  # [field, point]
):
    i = first + wp.tid()
    shift = wp.vec3f(61.3, 47.9, 83.1)  # the lattice's planes, where noise is zero, do not pass through the origin
    for k in range(cells.shape[0]):
        total = wp.float32(0.0)
        cell = cells[k]
        gain = wp.float32(1.0)
        for octave in range(octaves[k]):
            total += gain * wp.noise(wp.rand_init(seeds[k] + 31 * octave), points[i] / cell + shift)
            cell *= 0.5
            gain *= 0.5
        out[k, i] = NOISE_GAIN * total


@wp.func
def cell_of(p: wp.vec3f, low: wp.vec3f, cell: float) -> wp.vec3i:
    q = (p - low) / cell
    return wp.vec3i(int(wp.floor(q[0])), int(wp.floor(q[1])), int(wp.floor(q[2])))


@wp.kernel
def dabs(
    centers: wp.array[wp.vec3f],
    widths: wp.array[wp.float32],
    strengths: wp.array[wp.float32],
    kinds: wp.array[wp.int32],
    flat: wp.bool,  # exp(-(d / w)^4) instead of exp(-(d / w)^2)
    points: wp.array[wp.vec3f],  # sorted by cell
    numbers: wp.array[wp.int32],  # of the points before they were sorted
    starts: wp.array[wp.int32],  # of each cell's points, x slowest; one more at the end
    low: wp.vec3f,
    cell: float,
    size: wp.vec3i,
    out: wp.array2d[wp.float32],  # [kind, point], zero on entry
):
    """Raise the values of the points round each dab's centre to the dab's own."""
    i = wp.tid()
    center = centers[i]
    width = widths[i]
    strength = strengths[i]
    kind = kinds[i]
    if strength <= 0.0:
        return
    reach = wp.sqrt(REACH) * width
    around = wp.vec3f(reach, reach, reach)
    begin = cell_of(center - around, low, cell)
    end = cell_of(center + around, low, cell)
    z = wp.max(begin[2], 0)
    last = wp.min(end[2], size[2] - 1)
    if z > last:
        return
    for x in range(wp.max(begin[0], 0), wp.min(end[0] + 1, size[0])):
        for y in range(wp.max(begin[1], 0), wp.min(end[1] + 1, size[1])):
            row = (x * size[1] + y) * size[2]
            for k in range(starts[row + z], starts[row + last + 1]):
                d = points[k] - center
                q = wp.dot(d, d) / (width * width)
                if q < REACH:
                    if flat:
                        q = q * q
                    value = strength * wp.exp(-q)
                    if value > out[kind, numbers[k]]:  # others may write between: the maximum is right all the same
                        wp.atomic_max(out, kind, numbers[k], value)


wp.set_module_options({"enable_backward": False})


@wp.kernel
def normal(first: int, seeds: wp.array[wp.int32], n_each: int, out: wp.array2d[wp.float32]):
    i = first + wp.tid()
    b = i // n_each
    k = i - b * n_each
    state = wp.rand_init(seeds[b], k)
    out[b, k] = wp.randn(state)
