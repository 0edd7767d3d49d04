"""Light from all around as real spherical harmonics up to degree 2, and shadows from depth buffers: shared functions.

The nine functions are ordered 1, y, z, x, xy, yz, 3 z^2 - 1, xz, x^2 - y^2, all with positive sign.
"""

import warp as wp

vec9 = wp.types.vector(length=9, dtype=wp.float32)

TAPS = wp.constant(12)
BLOCKERS = wp.constant(6)
WIDEST = wp.constant(0.06)
"""Widest half shadow [m]."""
GOLDEN_ANGLE = wp.constant(2.3999632)


@wp.func
def harmonics(d: wp.vec3f) -> vec9:
    b = vec9()
    b[0] = 0.2820948
    b[1] = 0.4886025 * d[1]
    b[2] = 0.4886025 * d[2]
    b[3] = 0.4886025 * d[0]
    b[4] = 1.0925484 * d[0] * d[1]
    b[5] = 1.0925484 * d[1] * d[2]
    b[6] = 0.3153916 * (3.0 * d[2] * d[2] - 1.0)
    b[7] = 1.0925484 * d[0] * d[2]
    b[8] = 0.5462742 * (d[0] * d[0] - d[1] * d[1])
    return b


@wp.func
def cosine_lobe(n: wp.vec3f) -> vec9:
    """Harmonics of max(0, n . d) / pi: times a light's coefficients, its irradiance over pi (Ramamoorthi 2001)."""
    b = harmonics(n)
    for k in range(1, 4):
        b[k] = b[k] * (2.0 / 3.0)
    for k in range(4, 9):
        b[k] = b[k] * 0.25
    return b


@wp.func
def blurred(b: vec9, sharp: float) -> vec9:
    """Harmonics seen by a lobe that keeps `sharp` of degree 1 and its cube of degree 2."""
    for k in range(1, 4):
        b[k] = b[k] * sharp
    for k in range(4, 9):
        b[k] = b[k] * sharp * sharp * sharp
    return b


@wp.func
def light_along(sky: wp.array2d[wp.vec3f], image: int, b: vec9) -> wp.vec3f:
    total = wp.vec3f()
    for k in range(9):
        total += b[k] * sky[image, k]
    return wp.vec3f(wp.max(total[0], 0.0), wp.max(total[1], 0.0), wp.max(total[2], 0.0))


@wp.struct
class Lamps:
    """L round lamps for each of B images; a black one is none."""

    positions: wp.array2d[wp.vec3f]
    colors: wp.array2d[wp.vec3f]  # irradiance over pi at distance `ranges`
    ranges: wp.array2d[wp.float32]
    spreads: wp.array2d[wp.float32]  # radius over distance
    views: wp.array2d[wp.mat44f]  # to the lamp's frame
    focals: wp.array2d[wp.float32]  # of the depth buffers
    depths: wp.array3d[wp.float32]  # [image * lamp, row, column]


@wp.func
def disc(k: int, n: int, angle: float) -> wp.vec2f:
    """Point k of n that fill the unit disc evenly (Vogel's spiral)."""
    r = wp.sqrt((float(k) + 0.5) / float(n))
    a = angle + float(k) * GOLDEN_ANGLE
    return wp.vec2f(r * wp.cos(a), r * wp.sin(a))


@wp.func
def dither(x: int, y: int) -> float:
    """An angle for each pixel in [0, 2 pi), even over neighbours (interleaved gradient noise, Jimenez 2014)."""
    inner = 0.06711056 * float(x) + 0.00583715 * float(y)
    outer = 52.9829189 * (inner - wp.floor(inner))
    return 6.2831853 * (outer - wp.floor(outer))


@wp.func
def lamp_visibility(lamps: Lamps, b: int, lamp: int, p: wp.vec3f, n: wp.vec3f, angle: float, bias: float) -> float:
    """Share of a lamp of image `b` that `p` sees: percentage-closer soft shadows (Fernando 2005), with a slope bias."""
    q = wp.transform_point(lamps.views[b, lamp], p)
    m = wp.transform_vector(lamps.views[b, lamp], n)
    spread = lamps.spreads[b, lamp]
    buffer = b * lamps.positions.shape[1] + lamp
    size = lamps.depths.shape[1]
    half = 0.5 * float(size)
    if q[2] < 0.01:
        return 1.0
    scale = lamps.focals[b, lamp] / q[2]
    edge = half + WIDEST * scale
    if wp.abs(q[0]) * scale > edge or wp.abs(q[1]) * scale > edge:
        return 1.0  # the lamp's buffer shows all that casts shadows
    steep = wp.min(m[2], -0.18)  # towards the lamp is negative
    slope = wp.vec2f(-m[0] / steep, -m[1] / steep)  # of the surface's depth
    search = wp.clamp(spread * 0.10, 0.001, WIDEST)
    depth = wp.float32(0.0)
    found = wp.float32(0.0)
    for k in range(BLOCKERS):
        o = search * disc(k, BLOCKERS, angle)
        x = int(wp.floor((q[0] + o[0]) * scale + half))
        y = int(wp.floor((q[1] + o[1]) * scale + half))
        if x >= 0 and x < size and y >= 0 and y < size:
            z = lamps.depths[buffer, y, x]
            if z < q[2] + wp.clamp(slope[0] * o[0] + slope[1] * o[1], -search, search) - bias:
                depth += z
                found += 1.0
    radius = 0.6 / scale
    if found > 0.0:
        radius = wp.max(radius, spread * (q[2] - depth / found))
    else:
        radius = wp.max(radius, 0.0015)
    radius = wp.min(radius, WIDEST)
    seen = wp.float32(0.0)
    for k in range(TAPS):
        o = radius * disc(k, TAPS, angle)
        x = int(wp.floor((q[0] + o[0]) * scale + half))
        y = int(wp.floor((q[1] + o[1]) * scale + half))
        lit = wp.float32(1.0)
        if x >= 0 and x < size and y >= 0 and y < size:
            if lamps.depths[buffer, y, x] < q[2] + wp.clamp(slope[0] * o[0] + slope[1] * o[1], -radius, radius) - bias:
                lit = wp.float32(0.0)
        seen += lit
    return seen / float(TAPS)
