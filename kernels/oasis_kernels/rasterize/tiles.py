"""Lists of the Gaussians that each tile of the image must draw, nearest first.

A pair is one (Gaussian, tile). `count_tiles` and `emit_pairs` write the pairs in depth order of their Gaussians, one
thread per Gaussian, and a stable sort by tile gives each tile its Gaussians from front to back. Pairs are numbered so
that those of a Gaussian are neighbours, its tiles row by row: the number is a pair's address in the backward pass.

Counts are int64: a million Gaussians over 4096 tiles are more pairs than int32 holds.
"""

import warp as wp


@wp.func
def tile_box(box: wp.vec4i, tile_size: int) -> wp.vec4i:
    """Tiles x0, y0, x1, y1 (past the end) that a box of pixels touches; empty boxes touch none."""
    if box[0] >= box[2] or box[1] >= box[3]:
        return wp.vec4i(0, 0, 0, 0)
    return wp.vec4i(
        box[0] // tile_size, box[1] // tile_size, (box[2] - 1) // tile_size + 1, (box[3] - 1) // tile_size + 1
    )


@wp.kernel(enable_backward=False)
def count_tiles(first: int, boxes: wp.array(dtype=wp.vec4i), tile_size: int, counts: wp.array(dtype=wp.int64)):
    """Number of tiles of each Gaussian; one thread per (camera, Gaussian)."""
    index = first + wp.tid()
    t = tile_box(boxes[index], tile_size)
    counts[index] = wp.int64(t[2] - t[0]) * wp.int64(t[3] - t[1])


@wp.kernel(enable_backward=False)
def emit_pairs(
    first: int,
    order: wp.array(dtype=wp.int64),  # drawn Gaussians, nearest first
    starts: wp.array(dtype=wp.int64),  # number of each one's first pair, by camera * n + gaussian
    boxes: wp.array(dtype=wp.vec4i),
    n: int,
    tile_size: int,
    tiles_x: int,
    tiles_y: int,
    pair_tiles: wp.array(dtype=wp.int32),
    pair_gaussians: wp.array(dtype=wp.int32),
):
    """Tile (over all cameras) and Gaussian of each pair; one thread per drawn Gaussian."""
    index = int(order[first + wp.tid()])
    pair = starts[index]
    t = tile_box(boxes[index], tile_size)
    image = (index // n) * tiles_y
    for y in range(t[1], t[3]):
        for x in range(t[0], t[2]):
            pair_tiles[pair] = (image + y) * tiles_x + x
            pair_gaussians[pair] = index
            pair += wp.int64(1)
