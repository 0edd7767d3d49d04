"""Blend the Gaussians of each tile front to back (Kerbl et al. 2023, eq. 3) into image, alpha and transmittance.

One thread per (tile, lane). A lane owns a rectangle of the tile's pixels: the whole tile on the CPU, where one lane
walks the box of each Gaussian and nothing outside it; one pixel or a few on CUDA. The code is the same, each lane
intersects a Gaussian's box with its own rectangle, and each pixel sees the same arithmetic in the same order, so
neither tile size nor lanes nor threads change a bit of the picture. `weigh` stores the weights instead of the picture.

Pixels are flat, `(camera * height + y) * width + x`. While a tile is drawn its `transmittance` is negative where the
pixel has ended.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels import constants
from oasis_kernels.constants import Rules
from oasis_kernels.rasterize.gaussian import falloff, whitened


@wp.func
def lane_pixels(tile: int, lane: int, tile_size: int, lane_width: int, lane_height: int, tiles_x: int, tiles_y: int,
                width: int, height: int):
    """Camera and pixels x0, y0, x1, y1 (past the end) of a lane; the rectangle may be empty."""
    camera = tile // (tiles_x * tiles_y)
    tile_y = tile // tiles_x - camera * tiles_y
    tile_x = tile % tiles_x
    lanes_x = (tile_size + lane_width - 1) // lane_width
    x0 = tile_x * tile_size + (lane % lanes_x) * lane_width
    y0 = tile_y * tile_size + (lane // lanes_x) * lane_height
    x1 = wp.min(wp.min(x0 + lane_width, (tile_x + 1) * tile_size), width)
    y1 = wp.min(wp.min(y0 + lane_height, (tile_y + 1) * tile_size), height)
    return camera, wp.vec4i(x0, y0, x1, y1)


@wp.func
def from_centre(pixel: int, whole: Any, remainder: Any):
    """Signed distance of a pixel's centre from a Gaussian's, without the rounding of a large coordinate."""
    return (type(whole)(pixel) - whole) + (type(whole)(0.5) - remainder)


@wp.func
def exponent_cut(opacity: Any, alpha_min: Any):
    """The exponent from which a layer is surely fainter than `alpha_min`."""
    return wp.log(opacity / alpha_min) + type(opacity)(constants.CUT_SLACK)


@wp.func
def alpha_at(dx: Any, dy: Any, w: Any, opacity: Any, cut: Any):
    """Alpha of a layer off its centre before the cap, 0 beyond `cut`, and the whitened offset."""
    u, v = whitened(w, dx, dy)
    sigma = type(opacity)(0.5) * (u * u + v * v)
    alpha = type(opacity)(0.0)
    if sigma < cut:
        alpha = opacity * falloff(-sigma)
    return alpha, u, v


@functools.cache
def blend(scalar: Any, channels: int, rules: Rules) -> Any:
    """Kernel: the tiles' Gaussians -> image over the background, alpha, transmittance, and where each pixel ended."""
    alpha_min, stop = rules.alpha_min, rules.transmittance_stop
    vec4 = wp.types.vector(length=4, dtype=scalar)
    color = wp.types.vector(length=channels, dtype=scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def blend(
        first: int,
        tile_starts: wp.array(dtype=wp.int64),  # [tiles + 1]
        tile_gaussians: wp.array(dtype=wp.int32),  # front to back within each tile
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=scalar),  # [C * n], as the arrays around
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),  # [C]
        tile_size: int,
        lane_width: int,
        lane_height: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        image: wp.array(dtype=color),
        alphas: wp.array(dtype=scalar),  # sum of weights: 1 - T has no relative accuracy where little is drawn
        transmittance: wp.array(dtype=scalar),
        stops: wp.array(dtype=wp.int32),  # place in the tile's list of the first Gaussian that was not drawn
    ):
        task, lane = wp.tid()
        tile = first + task
        camera, area = lane_pixels(
            tile, lane, tile_size, lane_width, lane_height, tiles_x, tiles_y, width, height
        )
        start = tile_starts[tile]
        count = int(tile_starts[tile + 1] - start)
        for y in range(area[1], area[3]):
            for x in range(area[0], area[2]):
                pixel = (camera * height + y) * width + x
                image[pixel] = color()
                alphas[pixel] = scalar(0.0)
                transmittance[pixel] = scalar(1.0)
                stops[pixel] = count
        open_pixels = wp.max(area[2] - area[0], 0) * wp.max(area[3] - area[1], 0)

        for place in range(count):
            if open_pixels == 0:
                break
            g = tile_gaussians[start + wp.int64(place)]
            box = boxes[g]
            center = centers[g]
            w = whitenings[g]
            opacity = opacities[g]
            rgb = colors[g]
            cut = exponent_cut(opacity, scalar(alpha_min))
            for y in range(wp.max(area[1], box[1]), wp.min(area[3], box[3])):
                dy = from_centre(y, center[1], center[3])
                for x in range(wp.max(area[0], box[0]), wp.min(area[2], box[2])):
                    raw, _u, _v = alpha_at(from_centre(x, center[0], center[2]), dy, w, opacity, cut)
                    alpha = wp.min(raw, scalar(constants.ALPHA_MAX))
                    pixel = (camera * height + y) * width + x
                    before = transmittance[pixel]
                    if alpha >= scalar(alpha_min) and before > scalar(0.0):
                        after = before * (scalar(1.0) - alpha)
                        if after <= scalar(stop):
                            transmittance[pixel] = -before
                            stops[pixel] = place
                            open_pixels -= 1
                        else:
                            weight = alpha * before
                            image[pixel] = image[pixel] + rgb * weight
                            alphas[pixel] = alphas[pixel] + weight
                            transmittance[pixel] = after

        background = backgrounds[camera]
        for y in range(area[1], area[3]):
            for x in range(area[0], area[2]):
                pixel = (camera * height + y) * width + x
                left = wp.abs(transmittance[pixel])
                transmittance[pixel] = left
                image[pixel] = image[pixel] + background * left

    return blend


@functools.cache
def weigh(scalar: Any, rules: Rules) -> Any:
    """Kernel: the tiles' Gaussians -> weights alpha T of each pixel's layers, as rows of a sparse matrix.

    The loop of `blend` without colours runs twice. The first run counts the layers of each pixel. The second, with
    `write`, stores their Gaussians and weights front to back from the pixel's row start on.
    """
    alpha_min, stop = rules.alpha_min, rules.transmittance_stop
    vec4 = wp.types.vector(length=4, dtype=scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def weigh(
        first: int,
        tile_starts: wp.array(dtype=wp.int64),
        tile_gaussians: wp.array(dtype=wp.int32),
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=scalar),
        tile_size: int,
        lane_width: int,
        lane_height: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        write: int,
        row_starts: wp.array(dtype=wp.int64),  # [H * W + 1]; read where `write`
        transmittance: wp.array(dtype=scalar),  # scratch
        counts: wp.array(dtype=wp.int32),  # [H * W]
        columns: wp.array(dtype=wp.int32),
        values: wp.array(dtype=scalar),
    ):
        task, lane = wp.tid()
        tile = first + task
        _camera, area = lane_pixels(
            tile, lane, tile_size, lane_width, lane_height, tiles_x, tiles_y, width, height
        )
        for y in range(area[1], area[3]):
            for x in range(area[0], area[2]):
                transmittance[y * width + x] = scalar(1.0)
                counts[y * width + x] = 0
        for slot in range(int(tile_starts[tile]), int(tile_starts[tile + 1])):
            g = tile_gaussians[slot]
            box = boxes[g]
            center = centers[g]
            w = whitenings[g]
            opacity = opacities[g]
            cut = exponent_cut(opacity, scalar(alpha_min))
            for y in range(wp.max(area[1], box[1]), wp.min(area[3], box[3])):
                dy = from_centre(y, center[1], center[3])
                for x in range(wp.max(area[0], box[0]), wp.min(area[2], box[2])):
                    raw, _u, _v = alpha_at(from_centre(x, center[0], center[2]), dy, w, opacity, cut)
                    alpha = wp.min(raw, scalar(constants.ALPHA_MAX))
                    pixel = y * width + x
                    before = transmittance[pixel]
                    if alpha >= scalar(alpha_min) and before > scalar(0.0):
                        after = before * (scalar(1.0) - alpha)
                        if after <= scalar(stop):
                            transmittance[pixel] = -before
                        else:
                            transmittance[pixel] = after
                            layer = counts[pixel]
                            counts[pixel] = layer + 1
                            if write != 0:
                                place = row_starts[pixel] + wp.int64(layer)
                                columns[place] = g
                                values[place] = alpha * before

    return weigh
