"""Weights alpha T of the Gaussians in each pixel, as rows of a sparse matrix.

The loop of `rasterize_forward.blend` without colours, run twice: the first time it counts the layers of each pixel,
the second time it writes them, front to back, from the pixel's row start on. One thread per (tile, lane).
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels import constants
from oasis_kernels.constants import Rules
from oasis_kernels.rasterize.rasterize_forward import alpha_at, exponent_cut, from_centre, lane_pixels


@functools.cache
def weigh(scalar: Any, rules: Rules) -> Any:
    """Kernel: the tiles' Gaussians -> layers per pixel and, where `write`, their Gaussians and weights."""
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
