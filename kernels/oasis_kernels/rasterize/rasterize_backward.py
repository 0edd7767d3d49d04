"""Adjoint of the blending: replay each tile back to front, reduce to one record per pair, gather a Gaussian's pairs.

Let S be the colour seen behind a layer; behind the last one it is the background. Then dC/dalpha = T (c - S) and in
front of the layer S becomes alpha c + (1 - alpha) S: no division, every factor in [0, 1]. Contracted with the incoming
gradient g first, S is the one number `behind` of a pixel; the alpha image adds a background of -g_alpha. T comes from
the stored transmittance, divided back by the 1 - alpha of each layer.

A record holds sums over the pair's pixels, with y = W d the whitened offset and v = alpha dL/dalpha (0 where the layer
was capped): v, v y0, v y1, v y0^2, v y0 y1, v y1^2, and the colour gradient. Whitened sums stay well conditioned for
needles; the gather turns them into gradients in float64. Records lie at their pair's number, so that a Gaussian adds
its own in a fixed order: no atomics, and the same bits every time.
"""

import functools
from typing import Any

import warp as wp

from oasis_kernels import constants
from oasis_kernels.constants import Rules
from oasis_kernels.rasterize.rasterize_forward import alpha_at, exponent_cut, from_centre, lane_pixels

ADD_LANES = """
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset >>= 1) value += __shfl_xor_sync(0xffffffffu, value, offset);
#endif
    return value;
"""


@wp.func_native(ADD_LANES)
def add_lanes(value: wp.float32) -> wp.float32: ...


@wp.func_native(ADD_LANES)
def add_lanes(value: wp.float64) -> wp.float64: ...  # noqa: F811


@functools.cache
def blend_backward(scalar: Any, channels: int, rules: Rules) -> Any:
    """Kernel: gradients by image and alpha -> one record per pair and one background gradient per tile.

    One thread per (tile, lane); on CUDA the 32 lanes of a warp share a tile, on the CPU one lane has all of it.
    """
    alpha_min = rules.alpha_min
    vec4 = wp.types.vector(length=4, dtype=scalar)
    moments = wp.types.vector(length=6, dtype=scalar)
    color = wp.types.vector(length=channels, dtype=scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def blend_backward(
        first: int,
        tile_starts: wp.array(dtype=wp.int64),
        tile_gaussians: wp.array(dtype=wp.int32),
        tile_pairs: wp.array(dtype=wp.int64),  # number of the pair at each place
        boxes: wp.array(dtype=wp.vec4i),
        centers: wp.array(dtype=vec4),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=scalar),
        colors: wp.array(dtype=color),
        backgrounds: wp.array(dtype=color),
        stops: wp.array(dtype=wp.int32),
        g_image: wp.array(dtype=color),
        g_alpha: wp.array(dtype=scalar),
        tile_size: int,
        lane_width: int,
        lane_height: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        with_shape: int,  # 0: only colours and backgrounds want a gradient
        transmittance: wp.array(dtype=scalar),  # of the end; consumed
        behind: wp.array(dtype=scalar),  # scratch
        pair_moments: wp.array(dtype=moments),
        pair_colors: wp.array(dtype=color),
        tile_backgrounds: wp.array(dtype=color),
    ):
        task, lane = wp.tid()
        tile = first + task
        camera, area = lane_pixels(
            tile, lane, tile_size, lane_width, lane_height, tiles_x, tiles_y, width, height
        )
        start = tile_starts[tile]
        background = backgrounds[camera]
        g_background = color()
        for y in range(area[1], area[3]):
            for x in range(area[0], area[2]):
                pixel = (camera * height + y) * width + x
                g = g_image[pixel]
                behind[pixel] = wp.dot(g, background) - g_alpha[pixel]
                g_background += g * transmittance[pixel]
        for k in range(channels):
            g_background[k] = add_lanes(g_background[k])
        if lane == 0:
            tile_backgrounds[tile] = g_background

        count = int(tile_starts[tile + 1] - start)
        for step in range(count):
            place = count - 1 - step
            slot = start + wp.int64(place)
            index = tile_gaussians[slot]
            box = boxes[index]
            center = centers[index]
            w = whitenings[index]
            opacity = opacities[index]
            rgb = colors[index]
            cut = exponent_cut(opacity, scalar(alpha_min))
            m = moments()
            g_color = color()
            for y in range(wp.max(area[1], box[1]), wp.min(area[3], box[3])):
                dy = from_centre(y, center[1], center[3])
                for x in range(wp.max(area[0], box[0]), wp.min(area[2], box[2])):
                    raw, y0, y1 = alpha_at(from_centre(x, center[0], center[2]), dy, w, opacity, cut)
                    alpha = wp.min(raw, scalar(constants.ALPHA_MAX))
                    pixel = (camera * height + y) * width + x
                    if alpha >= scalar(alpha_min) and place < stops[pixel]:
                        t = transmittance[pixel] / (scalar(1.0) - alpha)
                        transmittance[pixel] = t
                        g = g_image[pixel]
                        g_color += g * (alpha * t)
                        if with_shape != 0:
                            s = behind[pixel]
                            step_up = wp.dot(g, rgb) - s
                            behind[pixel] = s + alpha * step_up
                            if raw <= scalar(constants.ALPHA_MAX):
                                v = alpha * t * step_up
                                m += moments(v, v * y0, v * y1, v * y0 * y0, v * y0 * y1, v * y1 * y1)
            pair = tile_pairs[slot]
            if with_shape != 0:
                for k in range(6):
                    m[k] = add_lanes(m[k])
                if lane == 0:
                    pair_moments[pair] = m
            for k in range(channels):
                g_color[k] = add_lanes(g_color[k])
            if lane == 0:
                pair_colors[pair] = g_color

    return blend_backward


Moments = wp.types.vector(length=6, dtype=wp.float64)
"""The sums of a record, over all pairs of a Gaussian."""


@wp.func
def shape_gradients(w: wp.vec4d, m: Moments):
    """Gradients by the centre in the image and by the covariance xx, xy, yy; xy stands for both off-diagonal entries.

    sigma = |W d|^2 / 2 with d from the centre to the pixel: dsigma/dcentre = -W^T y, dsigma/dcovariance =
    -W^T y y^T W / 2, and dL/dsigma = -v.
    """
    half = wp.float64(0.5)
    by_center = wp.vec2d(w[0] * m[1] + w[2] * m[2], w[1] * m[1] + w[3] * m[2])
    xx = w[0] * (w[0] * m[3] + w[2] * m[4]) + w[2] * (w[0] * m[4] + w[2] * m[5])
    xy = w[1] * (w[0] * m[3] + w[2] * m[4]) + w[3] * (w[0] * m[4] + w[2] * m[5])
    yy = w[1] * (w[1] * m[3] + w[3] * m[4]) + w[3] * (w[1] * m[4] + w[3] * m[5])
    return by_center, wp.vec3d(half * xx, xy, half * yy)


@functools.cache
def gather_shape(scalar: Any) -> Any:
    """Kernel: records -> gradients by means2d, covars2d and opacities; one thread per (camera, Gaussian)."""
    vec2, vec4 = (wp.types.vector(length=n, dtype=scalar) for n in (2, 4))
    moments = wp.types.vector(length=6, dtype=scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def gather_shape(
        first: int,
        pair_starts: wp.array(dtype=wp.int64),  # by camera * n + gaussian
        pair_counts: wp.array(dtype=wp.int64),
        pair_moments: wp.array(dtype=moments),
        whitenings: wp.array(dtype=vec4),
        opacities: wp.array(dtype=scalar),
        g_means2d: wp.array(dtype=vec2),
        g_covars2d: wp.array(dtype=wp.vec3d),
        g_opacities: wp.array(dtype=scalar),
    ):
        index = first + wp.tid()
        m = Moments()
        start = pair_starts[index]
        for k in range(int(pair_counts[index])):
            record = pair_moments[start + wp.int64(k)]
            for j in range(6):
                m[j] += wp.float64(record[j])
        g_opacity = wp.float64(0.0)
        if pair_counts[index] > wp.int64(0):
            g_opacity = m[0] / wp.float64(opacities[index])
        by_center, by_covariance = shape_gradients(wp.vec4d(whitenings[index]), m)
        g_means2d[index] = vec2(scalar(by_center[0]), scalar(by_center[1]))
        g_covars2d[index] = by_covariance
        g_opacities[index] = scalar(g_opacity)

    return gather_shape


@functools.cache
def gather_colors(scalar: Any, channels: int) -> Any:
    """Kernel: records -> gradients by colours; one thread per (camera, Gaussian)."""
    color = wp.types.vector(length=channels, dtype=scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def gather_colors(
        first: int,
        pair_starts: wp.array(dtype=wp.int64),
        pair_counts: wp.array(dtype=wp.int64),
        pair_colors: wp.array(dtype=color),
        g_colors: wp.array(dtype=color),
    ):
        index = first + wp.tid()
        start = pair_starts[index]
        total = color()
        for k in range(int(pair_counts[index])):
            total += pair_colors[start + wp.int64(k)]
        g_colors[index] = total

    return gather_colors


@functools.cache
def sum_backgrounds(scalar: Any, channels: int) -> Any:
    """Kernel: background gradients of the tiles -> of the cameras, added in order; one thread per camera."""
    color = wp.types.vector(length=channels, dtype=scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def sum_backgrounds(
        first: int, tiles: int, tile_backgrounds: wp.array(dtype=color), g_backgrounds: wp.array(dtype=color)
    ):
        camera = first + wp.tid()
        total = color()
        for k in range(tiles):
            total += tile_backgrounds[camera * tiles + k]
        g_backgrounds[camera] = total

    return sum_backgrounds
