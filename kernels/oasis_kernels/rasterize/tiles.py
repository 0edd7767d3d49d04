"""Which Gaussians each tile of the image must draw, nearest first.

A pair is one (Gaussian, tile). Pairs are numbered so that those of a Gaussian are neighbours, its tiles row by row:
the number is a pair's address in the backward pass. Two ways lead from boxes to lists:

- on CUDA, `count_tiles` and `emit_pairs` write the pairs in depth order of their Gaussians, one thread a Gaussian, and
  a stable sort by tile gives each tile its Gaussians from front to back;
- on the CPU, `collect` and `deal` do it in two loops on one thread: going through the Gaussians in depth order, each
  is put at the end of its tiles' lists, whose lengths are known from the first loop.

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
    """Number of tiles of each Gaussian; one thread a (camera, Gaussian)."""
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
    """Tile (over all cameras) and Gaussian of each pair; one thread a drawn Gaussian."""
    index = int(order[first + wp.tid()])
    pair = starts[index]
    t = tile_box(boxes[index], tile_size)
    image = (index // n) * tiles_y
    for y in range(t[1], t[3]):
        for x in range(t[0], t[2]):
            pair_tiles[pair] = (image + y) * tiles_x + x
            pair_gaussians[pair] = index
            pair += wp.int64(1)


@wp.kernel(enable_backward=False)
def collect(
    boxes: wp.array(dtype=wp.vec4i),
    depths: wp.array(dtype=wp.float64),
    n: int,
    tile_size: int,
    tiles_x: int,
    tiles_y: int,
    pair_starts: wp.array(dtype=wp.int64),
    pair_counts: wp.array(dtype=wp.int64),
    tile_boxes: wp.array(dtype=wp.vec4i),  # with y counted over all cameras
    drawn_depths: wp.array(dtype=wp.float64),
    drawn: wp.array(dtype=wp.int32),
    tile_starts: wp.array(dtype=wp.int64),  # zeros come in
    totals: wp.array(dtype=wp.int64),  # drawn Gaussians, pairs
):
    """Drawn Gaussians, numbers of their pairs in order of memory, and first places of the tiles. One thread in all."""
    n_drawn = wp.int32(0)  # not a bare literal: those are constants to Warp
    n_pairs = wp.int64(0)
    for camera in range(boxes.shape[0] // n):
        above = camera * tiles_y
        for index in range(camera * n, camera * n + n):
            t = tile_box(boxes[index], tile_size)
            count = wp.int64(t[2] - t[0]) * wp.int64(t[3] - t[1])
            pair_starts[index] = n_pairs
            pair_counts[index] = count
            if count > wp.int64(0):
                tile_boxes[index] = wp.vec4i(t[0], t[1] + above, t[2], t[3] + above)
                n_pairs += count
                drawn_depths[n_drawn] = depths[index]
                drawn[n_drawn] = index
                n_drawn += 1
                for y in range(t[1] + above, t[3] + above):
                    for x in range(t[0], t[2]):
                        place = y * tiles_x + x + 1
                        tile_starts[place] = tile_starts[place] + wp.int64(1)
    for tile in range(1, tile_starts.shape[0]):
        tile_starts[tile] = tile_starts[tile] + tile_starts[tile - 1]
    totals[0] = wp.int64(n_drawn)
    totals[1] = n_pairs


@wp.kernel(enable_backward=False)
def deal(
    order: wp.array(dtype=wp.int32),  # drawn Gaussians, nearest first
    n_drawn: int,
    tile_boxes: wp.array(dtype=wp.vec4i),
    tiles_x: int,
    pair_starts: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=wp.int64),  # of each tile's list so far: a copy of the starts comes in
    tile_gaussians: wp.array(dtype=wp.int32),
    tile_pairs: wp.array(dtype=wp.int64),
):
    """Put each Gaussian at the end of its tiles' lists. One thread in all."""
    for rank in range(n_drawn):
        index = order[rank]
        pair = pair_starts[index]
        t = tile_boxes[index]
        for y in range(t[1], t[3]):
            for x in range(t[0], t[2]):
                tile = y * tiles_x + x
                place = ends[tile]
                ends[tile] = place + wp.int64(1)
                tile_gaussians[place] = index
                tile_pairs[place] = pair
                pair += wp.int64(1)
