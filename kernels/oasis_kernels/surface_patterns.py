"""Patterns on a surface: gradient noise, and lines drawn as rows of samples. One thread a point of the surface.

Everything is evaluated at points in space, so that a pattern has no seam where its texture has one.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

NOISE_GAIN = wp.constant(1.5)
"""Brings gradient noise, which hardly reaches +-0.7, to about [-1, 1]."""


@wp.kernel
def noise(
    first: int,
    points: wp.array[wp.vec3f],
    cells: wp.array[wp.float32],  # size of a cell of each field
    seeds: wp.array[wp.int32],
    octaves: wp.array[wp.int32],  # each half as large and half as strong as the one before
    out: wp.array2d[wp.float32],
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
        out[i, k] = NOISE_GAIN * total


@wp.func
def cell_of(p: wp.vec3f, low: wp.vec3f, cell: float, size: wp.vec3i) -> wp.vec3i:
    q = (p - low) / cell
    return wp.vec3i(
        wp.clamp(int(wp.floor(q[0])), 0, size[0] - 1),
        wp.clamp(int(wp.floor(q[1])), 0, size[1] - 1),
        wp.clamp(int(wp.floor(q[2])), 0, size[2] - 1),
    )


@wp.kernel
def lines(
    first: int,
    points: wp.array[wp.vec3f],
    samples: wp.array[wp.vec3f],  # sorted by cell
    widths: wp.array[wp.float32],
    strengths: wp.array[wp.float32],
    kinds: wp.array[wp.int32],
    starts: wp.array[wp.int32],  # of each cell's samples, x slowest; one more at the end
    low: wp.vec3f,
    cell: float,
    size: wp.vec3i,
    out: wp.array2d[wp.float32],  # [point, kind], zero on entry
):
    """The largest strength exp(-(distance / width)^2) of the samples of each kind; cells are as large as the reach."""
    i = first + wp.tid()
    p = points[i]
    c = cell_of(p, low, cell, size)
    for x in range(wp.max(c[0] - 1, 0), wp.min(c[0] + 2, size[0])):
        for y in range(wp.max(c[1] - 1, 0), wp.min(c[1] + 2, size[1])):
            row = (x * size[1] + y) * size[2]
            begin = starts[row + wp.max(c[2] - 1, 0)]
            end = starts[row + wp.min(c[2] + 2, size[2])]
            for s in range(begin, end):
                d = p - samples[s]
                q = wp.dot(d, d) / (widths[s] * widths[s])
                if q < 8.0:
                    value = strengths[s] * wp.exp(-q)
                    if value > out[i, kinds[s]]:
                        out[i, kinds[s]] = value
