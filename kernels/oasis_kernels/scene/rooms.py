"""Rooms of boxes, balls and cylinders behind a hand, traced a few rays per pixel, and the blur of what is out of focus.

`trace`: one thread per pixel; everything in the camera's frame, the camera at the origin. A solid is a row of
SOLID_WORDS numbers: shape, pattern, pattern size [m], gloss, glow, seed; centre; half sizes; the rotation from the
camera's frame to its own (rows); two colours. Light is the sky by its harmonics, darkened near other solids by their
distance fields (Evans 2006), and the lamps with the hand's soft shadow and a marched one of the solids.
"""

import warp as wp

from oasis_kernels.runtime.arrays import image_row_column
from oasis_kernels.scene.room_patterns import CLOTH, painted, rough_noise
from oasis_kernels.scene.sky import Lamps, blurred, cosine_lobe, disc, dither, harmonics, lamp_visibility, light_along

wp.set_module_options({"enable_backward": False})  # fast_math makes NaN of powers: a dot product may exceed 1

SOLID_WORDS = wp.constant(27)
SHAPE, PATTERN, CELL, GLOSS, GLOW, SEED = (wp.constant(k) for k in range(6))
CENTER, HALF, ROTATION, FIRST, SECOND = (wp.constant(k) for k in (6, 9, 12, 21, 24))

NOTHING, BOX, BALL, CYLINDER = (wp.constant(k) for k in range(4))
FAR = wp.constant(60.0)
BLUR_TAPS = wp.constant(24)
RAYS = wp.constant(2)
"""A pixel."""


@wp.func
def vector_at(solids: wp.array3d[wp.float32], b: int, k: int, at: int) -> wp.vec3f:
    return wp.vec3f(solids[b, k, at], solids[b, k, at + 1], solids[b, k, at + 2])


@wp.func
def to_solid(solids: wp.array3d[wp.float32], b: int, k: int, v: wp.vec3f) -> wp.vec3f:
    """A vector of the camera's frame in that of a solid."""
    return wp.vec3f(
        wp.dot(vector_at(solids, b, k, ROTATION), v),
        wp.dot(vector_at(solids, b, k, ROTATION + 3), v),
        wp.dot(vector_at(solids, b, k, ROTATION + 6), v),
    )


@wp.func
def from_solid(solids: wp.array3d[wp.float32], b: int, k: int, v: wp.vec3f) -> wp.vec3f:
    """The inverse of `to_solid`."""
    return (
        v[0] * vector_at(solids, b, k, ROTATION)
        + v[1] * vector_at(solids, b, k, ROTATION + 3)
        + v[2] * vector_at(solids, b, k, ROTATION + 6)
    )


@wp.func
def ray_entry(shape: int, half: wp.vec3f, o: wp.vec3f, d: wp.vec3f) -> float:
    """Distance along the ray to the solid, FAR where it misses or starts inside."""
    t = float(FAR)
    if shape == BOX:
        near = float(-FAR)
        away = float(FAR)
        for c in range(3):
            inv = 1.0 / (d[c] if wp.abs(d[c]) > 1.0e-9 else 1.0e-9)
            a = (-half[c] - o[c]) * inv
            e = (half[c] - o[c]) * inv
            near = wp.max(near, wp.min(a, e))
            away = wp.min(away, wp.max(a, e))
        if near < away and near > 1.0e-4:
            t = near
    elif shape == BALL:
        p = wp.cw_div(o, half)
        q = wp.cw_div(d, half)
        a = wp.dot(q, q)
        h = wp.dot(p, q)
        r = wp.dot(p, p) - 1.0
        root = h * h - a * r
        if root > 0.0:
            s = (-h - wp.sqrt(root)) / a
            if s > 1.0e-4:
                t = s
    else:  # upright: along its second axis
        a = d[0] * d[0] + d[2] * d[2]
        h = o[0] * d[0] + o[2] * d[2]
        r = o[0] * o[0] + o[2] * o[2] - half[0] * half[0]
        root = h * h - a * r
        if root > 0.0 and a > 1.0e-9:
            s = (-h - wp.sqrt(root)) / a
            if s > 1.0e-4 and wp.abs(o[1] + s * d[1]) <= half[1]:
                t = s
        if wp.abs(d[1]) > 1.0e-9:
            s = (-wp.sign(d[1]) * half[1] - o[1]) / d[1]
            x, z = o[0] + s * d[0], o[2] + s * d[2]
            if s > 1.0e-4 and x * x + z * z <= half[0] * half[0]:
                t = wp.min(t, s)
    return t


@wp.func
def may_hit(center: wp.vec3f, half: wp.vec3f, d: wp.vec3f) -> bool:
    """Whether a ray from the camera may meet a solid: whether it comes near the ball round it, rounding allowed for."""
    ahead = wp.dot(center, d)
    away = wp.dot(center, center)
    size = wp.dot(half, half)
    return away - ahead * ahead < 1.001 * size + 1.0e-5 * away and (ahead > 0.0 or away < 1.001 * size)


@wp.func
def signed_distance(solids: wp.array3d[wp.float32], b: int, p: wp.vec3f, limit: float) -> float:
    """Distance to the nearest solid, negative inside one; `limit` where all are further away."""
    least = limit
    for k in range(solids.shape[1]):
        shape = int(solids[b, k, SHAPE])
        if shape != NOTHING:
            q = p - vector_at(solids, b, k, CENTER)
            half = vector_at(solids, b, k, HALF)
            reach = wp.length(half) + least
            if wp.dot(q, q) < reach * reach:
                q = to_solid(solids, b, k, q)
                if shape == BOX:
                    e = wp.vec3f(wp.abs(q[0]) - half[0], wp.abs(q[1]) - half[1], wp.abs(q[2]) - half[2])
                    out = wp.vec3f(wp.max(e[0], 0.0), wp.max(e[1], 0.0), wp.max(e[2], 0.0))
                    least = wp.min(least, wp.length(out) + wp.min(wp.max(e[0], wp.max(e[1], e[2])), 0.0))
                elif shape == BALL:
                    least = wp.min(
                        least, (wp.length(wp.cw_div(q, half)) - 1.0) * wp.min(half[0], wp.min(half[1], half[2]))
                    )
                else:
                    r = wp.sqrt(q[0] * q[0] + q[2] * q[2]) - half[0]
                    y = wp.abs(q[1]) - half[1]
                    out2 = wp.vec2f(wp.max(r, 0.0), wp.max(y, 0.0))
                    least = wp.min(least, wp.length(out2) + wp.min(wp.max(r, y), 0.0))
    return least


@wp.func
def trace_ray(
    b: int,
    d: wp.vec3f,
    angle: float,
    solids: wp.array3d[wp.float32],
    sky: wp.array2d[wp.vec3f],
    lamps: Lamps,
) -> wp.vec4f:
    """Light and depth along the ray `d` from the camera."""
    t = float(FAR)
    hit = wp.int32(-1)
    for k in range(solids.shape[1]):
        shape = int(solids[b, k, SHAPE])
        if shape != NOTHING:
            center = vector_at(solids, b, k, CENTER)
            size = vector_at(solids, b, k, HALF)
            if may_hit(center, size, d):
                s = ray_entry(shape, size, to_solid(solids, b, k, -center), to_solid(solids, b, k, d))
                if s < t:
                    t = s
                    hit = k
    if hit < 0:
        sky_light = 2.0 * light_along(sky, b, blurred(harmonics(d), 0.8))
        return wp.vec4f(sky_light[0], sky_light[1], sky_light[2], FAR)
    p = t * d
    shape = int(solids[b, hit, SHAPE])
    half = vector_at(solids, b, hit, HALF)
    q = to_solid(solids, b, hit, p - vector_at(solids, b, hit, CENTER))
    n = wp.vec3f(0.0, 1.0, 0.0)
    u, v = q[0], q[2]
    if shape == BOX:
        e = wp.vec3f(wp.abs(q[0]) / half[0], wp.abs(q[1]) / half[1], wp.abs(q[2]) / half[2])
        if e[0] > e[1] and e[0] > e[2]:
            n = wp.vec3f(wp.sign(q[0]), 0.0, 0.0)
            u, v = q[2], q[1]
        elif e[1] > e[2]:
            n = wp.vec3f(0.0, wp.sign(q[1]), 0.0)
        else:
            n = wp.vec3f(0.0, 0.0, wp.sign(q[2]))
            u, v = q[0], q[1]
    elif shape == BALL:
        n = wp.normalize(wp.cw_div(q, wp.cw_mul(half, half)))
        u, v = wp.atan2(q[2], q[0]) * half[0], q[1]
    else:
        if wp.abs(q[1]) < 0.999 * half[1]:
            n = wp.normalize(wp.vec3f(q[0], 0.0, q[2]))
            u, v = wp.atan2(q[2], q[0]) * half[0], q[1]
        else:
            n = wp.vec3f(0.0, wp.sign(q[1]), 0.0)
    seed = int(solids[b, hit, SEED])
    base = painted(
        int(solids[b, hit, PATTERN]),
        u,
        v,
        solids[b, hit, CELL],
        seed,
        q,
        vector_at(solids, b, hit, FIRST),
        vector_at(solids, b, hit, SECOND),
    )
    if int(solids[b, hit, PATTERN]) == CLOTH:  # wrinkles
        g = rough_noise(q / 0.09, seed + 50, 2)
        n = n + 1.1 * wp.vec3f(
            rough_noise((q + wp.vec3f(0.008, 0.0, 0.0)) / 0.09, seed + 50, 2) - g,
            rough_noise((q + wp.vec3f(0.0, 0.008, 0.0)) / 0.09, seed + 50, 2) - g,
            rough_noise((q + wp.vec3f(0.0, 0.0, 0.008)) / 0.09, seed + 50, 2) - g,
        )
        n = wp.normalize(n)
    n = from_solid(solids, b, hit, n)
    glow = solids[b, hit, GLOW]
    gloss = solids[b, hit, GLOSS]
    open_ = wp.float32(1.0)
    widest = wp.clamp(0.12 * p[2], 0.02, 0.3)
    rolled = wp.int32(2)  # a number that the compiler does not know: code for each turn would not fit into the cache
    for k in range(rolled):
        reach = widest * (0.2 + 0.8 * float(k))
        open_ -= (reach - signed_distance(solids, b, p + reach * n, reach)) / reach * 0.36
    open_ = wp.max(open_, 0.12)
    total = light_along(sky, b, cosine_lobe(n)) * open_
    for lamp in range(lamps.positions.shape[1]):
        color = lamps.colors[b, lamp]
        if color[0] + color[1] + color[2] > 0.0:
            to = lamps.positions[b, lamp] - p
            distance = wp.length(to)
            w = to / distance
            facing = wp.dot(n, w)
            if facing > 0.0:
                fall = lamps.ranges[b, lamp] / distance
                share = lamp_visibility(lamps, b, lamp, p, n, angle, 0.002)
                if share > 0.0 and lamp == 0:  # the first lamp's shadows of the solids themselves
                    s = 0.015 + 0.0016 * angle
                    soft = 1.0 / wp.max(lamps.spreads[b, lamp], 0.05)
                    rolled = wp.int32(5)
                    for _k in range(rolled):
                        # Further away nothing darkens and no step is longer.
                        near = signed_distance(solids, b, p + 0.004 * n + s * w, wp.max(1.01 * s / soft, 0.3))
                        share = wp.min(share, wp.clamp(0.5 + 0.5 * soft * near / s, 0.0, 1.0))
                        s += wp.clamp(near, 0.03, 0.3)
                total += color * (fall * fall * facing * share)
    back = d - 2.0 * wp.dot(d, n) * n
    facing_view = wp.clamp(-wp.dot(d, n), 0.0, 1.0)
    mirror = gloss * (0.04 + 0.6 * wp.pow(1.0 - facing_view, 5.0))
    shown = wp.cw_mul(base, total) + mirror * open_ * light_along(sky, b, blurred(harmonics(back), 0.85))
    shown = shown + glow * base
    return wp.vec4f(shown[0], shown[1], shown[2], p[2])


@wp.kernel
def trace(
    first: int,
    solids: wp.array3d[wp.float32],
    focals: wp.array[wp.float32],
    sky: wp.array2d[wp.vec3f],
    lamps: Lamps,
    hidden: wp.array3d[wp.float32],  # where this is 1 the hand covers the pixel and nothing is traced
    light: wp.array3d[wp.vec3f],
    depth: wp.array3d[wp.float32],
):
    rows, columns = light.shape[1], light.shape[2]
    b, y, x = image_row_column(first + wp.tid(), rows, columns)
    total = wp.vec3f()
    nearest = float(FAR)
    if hidden[b, y, x] <= 0.999:
        angle = dither(x, y)
        rolled = wp.int32(RAYS)
        for k in range(rolled):
            right = float(x) + (float(k) + 0.5) / float(RAYS) - 0.5 * float(columns)
            down = float(y) + (0.3 if k % 2 == 0 else 0.7) - 0.5 * float(rows)
            d = wp.normalize(wp.vec3f(right / focals[b], down / focals[b], 1.0))
            s = trace_ray(
                b,
                d,
                angle + 1.2 * float(k),
                solids,
                sky,
                lamps,
            )
            total += wp.vec3f(s[0], s[1], s[2]) / float(RAYS)
            nearest = wp.min(nearest, s[3])
    light[b, y, x] = total
    depth[b, y, x] = nearest


@wp.kernel
def defocus(
    first: int,
    depth: wp.array3d[wp.float32],
    hidden: wp.array3d[wp.float32],
    focus: wp.array[wp.float32],  # depth that is sharp
    apertures: wp.array[wp.float32],  # radius of blur far off over the width of the picture
    light: wp.array3d[wp.vec3f],
    out: wp.array3d[wp.vec3f],
):
    """Gathers over a disc as large as the pixel's own circle of confusion; what the hand hides does not count."""
    rows, columns = light.shape[1], light.shape[2]
    b, y, x = image_row_column(first + wp.tid(), rows, columns)
    if hidden[b, y, x] > 0.999:
        out[b, y, x] = light[b, y, x]
        return
    radius = apertures[b] * float(columns) * wp.abs(1.0 - focus[b] / depth[b, y, x])
    radius = wp.max(radius, 0.85)
    angle = dither(x, y)
    total = light[b, y, x] * 0.5
    weight = wp.float32(0.5)
    for k in range(BLUR_TAPS):
        o = radius * disc(k, BLUR_TAPS, angle)
        u = wp.clamp(int(wp.floor(float(x) + 0.5 + o[0])), 0, columns - 1)
        v = wp.clamp(int(wp.floor(float(y) + 0.5 + o[1])), 0, rows - 1)
        if hidden[b, v, u] < 0.999:
            own = apertures[b] * float(columns) * wp.abs(1.0 - focus[b] / depth[b, v, u])
            w = wp.float32(1.0)
            if depth[b, v, u] < depth[b, y, x] and wp.max(own, 0.7) < wp.length(o):
                w = 0.15  # what is sharp does not smear into what lies behind it
            total += w * light[b, v, u]
            weight += w
    out[b, y, x] = total / weight
