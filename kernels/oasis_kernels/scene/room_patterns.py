"""Reflectance of what rooms are built of: procedural patterns, functions of a place on a solid's face and a seed."""

import warp as wp

PAINT, PLANKS, TILES, CLOTH, SPECKS, STRIPES, BOOKS, KEYS, TEXT, PICTURE, PANES, LEAVES, PANELS, CARPET = (
    wp.constant(k) for k in range(14)
)


@wp.func
def hashed(i: int, j: int, seed: int) -> float:
    """Uniform in [0, 1)."""
    return wp.randf(wp.rand_init(seed + 7919 * i, j))


@wp.func
def rough_noise(p: wp.vec3f, seed: int, octaves: int) -> float:
    total = wp.float32(0.0)
    gain = wp.float32(1.0)
    q = p + wp.vec3f(31.4, 17.9, 5.3)
    for k in range(octaves):
        total += gain * wp.noise(wp.rand_init(seed + k), q)
        q = 2.03 * q
        gain *= 0.5
    return 1.5 * total


@wp.func
def groove(x: float, width: float) -> float:
    """1 on lines at whole numbers, 0 off them."""
    away = wp.abs(x - wp.floor(x + 0.5))
    return wp.exp(-(away * away) / (width * width))


@wp.func
def painted(
    pattern: int, u: float, v: float, cell: float, seed: int, p: wp.vec3f, a: wp.vec3f, e: wp.vec3f
) -> wp.vec3f:
    """Reflectance at (u, v) [m] of a face, `p` the point in the solid's own frame."""
    c = a
    x, y = u / cell, v / cell
    if pattern == PAINT:
        c = a * (1.0 + 0.05 * rough_noise(p / 0.5, seed, 2) + 0.02 * rough_noise(p / 0.01, seed + 5, 1))
    elif pattern == PLANKS:
        row = int(wp.floor(y))
        shift = 7.0 * hashed(row, 1, seed)
        length = wp.float32(11.0)
        board = int(wp.floor(x / length + shift))
        tone = hashed(row, board, seed + 3)
        g = rough_noise(wp.vec3f(0.35 * x + 40.0 * tone, 5.0 * y, 9.0 * tone), seed, 3)
        fine = rough_noise(wp.vec3f(1.2 * x, 26.0 * y, 3.0 * tone), seed + 9, 1)
        c = (a + (e - a) * tone) * (0.88 + 0.22 * g + 0.09 * fine)
        line = wp.max(groove(y, 0.018), groove(x / length + shift, 0.0016))
        c = c * (1.0 - 0.7 * line)
    elif pattern == TILES:
        i, j = int(wp.floor(x)), int(wp.floor(y))
        tone = hashed(i, j, seed)
        c = a * (0.9 + 0.2 * tone + 0.06 * rough_noise(4.0 * wp.vec3f(x, y, tone), seed, 3))
        line = wp.max(groove(x, 0.015), groove(y, 0.015))
        c = c + (e - c) * line
    elif pattern == CLOTH:
        weave = wp.sin(6.2832 * u / 0.0035) * wp.sin(6.2832 * v / 0.0035)
        c = a * (1.0 + 0.12 * weave + 0.2 * rough_noise(p / 0.07, seed, 3))
        c = c + (e - c) * 0.6 * wp.clamp(groove(x, 0.06) + groove(y, 0.06), 0.0, 1.0)
    elif pattern == SPECKS:
        n = rough_noise(p / cell, seed, 3)
        f = rough_noise(p / (0.12 * cell), seed + 11, 2)
        c = a + (e - a) * wp.clamp(0.5 + 1.6 * n, 0.0, 1.0)
        c = c * (1.0 + 0.35 * f)
    elif pattern == STRIPES:
        wave = 0.5 + 0.5 * wp.sin(6.2832 * (x + 0.25 * rough_noise(wp.vec3f(0.3 * x, 0.0, 0.2 * y), seed, 1)))
        c = a + (e - a) * wave
    elif pattern == BOOKS:
        shelf = int(wp.floor(y / 7.0))
        rise = y / 7.0 - wp.floor(y / 7.0)
        slot = int(wp.floor(x + 0.35 * hashed(int(wp.floor(x)), shelf, seed)))
        tall = 0.55 + 0.35 * hashed(slot, shelf, seed + 1)
        hue = wp.vec3f(hashed(slot, shelf, seed + 2), hashed(slot, shelf, seed + 3), hashed(slot, shelf, seed + 4))
        grey = (hue[0] + hue[1] + hue[2]) / 3.0
        book = 0.02 + 0.75 * grey * grey
        c = book * (wp.vec3f(0.8, 0.76, 0.7) + 0.35 * (hue - wp.vec3f(grey, grey, grey)))
        c = c * (1.0 - 0.5 * groove(x, 0.08))
        c = c * (1.0 + 0.6 * groove(3.0 * rise + hashed(slot, shelf, seed + 5), 0.12))
        if rise > tall:
            c = 0.06 * a
        if rise < 0.07:
            c = a
    elif pattern == KEYS:
        i, j = int(wp.floor(x)), int(wp.floor(y))
        fx, fy = x - wp.floor(x), y - wp.floor(y)
        c = e
        if fx > 0.1 and fx < 0.9 and fy > 0.1 and fy < 0.9:
            c = a
            if wp.abs(fx - 0.4) < 0.09 and wp.abs(fy - 0.4) < 0.13 and hashed(i, j, seed) > 0.1:
                c = a + 0.22 * (wp.vec3f(0.8, 0.8, 0.8) - a)
    elif pattern == TEXT:
        j = int(wp.floor(y))
        fy = y - wp.floor(y)
        word = rough_noise(wp.vec3f(1.1 * x, 3.7 * float(j), 0.0), seed, 1)
        c = a
        if fy > 0.3 and fy < 0.75 and word > -0.35 and hashed(j, 3, seed) > 0.12:
            c = a + (e - a) * (0.55 + 0.3 * hashed(int(wp.floor(6.0 * x)), j, seed))
    elif pattern == PICTURE:
        n = rough_noise(p / cell, seed, 4)
        m = rough_noise(p / (0.7 * cell) + wp.vec3f(9.0, 0.0, 0.0), seed + 21, 3)
        c = a + (e - a) * wp.clamp(0.5 + 0.9 * n, 0.0, 1.0)
        c = c * wp.clamp(0.9 + 0.5 * m, 0.3, 1.5)
        if m > 0.35:
            c = 0.5 * (a + e) * wp.clamp(1.0 - 1.5 * n, 0.2, 1.5)
    elif pattern == PANES:
        c = a * (0.75 + 0.5 * rough_noise(p / (1.7 * cell), seed, 3))
        if v > 0.0:
            c = wp.cw_mul(c, wp.vec3f(0.55, 0.62, 0.5))
        line = wp.max(groove(x, 0.05), groove(y, 0.04))
        c = c + (0.2 * e - c) * wp.clamp(1.6 * line, 0.0, 1.0)
    elif pattern == LEAVES:
        n = rough_noise(p / cell, seed, 4)
        m = rough_noise(p / (0.35 * cell), seed + 3, 2)
        c = a * wp.clamp(0.55 + 1.5 * m, 0.03, 2.0)
        if n + 0.4 * m > 0.25:
            c = e * wp.clamp(0.8 + m, 0.1, 1.8)
    elif pattern == PANELS:  # doors and cupboards
        line = wp.max(groove(x, 0.012), groove(y / 1.9, 0.008))
        inset = wp.max(groove(x + 0.16, 0.012), groove(x - 0.16, 0.012))
        c = a * (1.0 - 0.75 * line - 0.22 * inset + 0.10 * rough_noise(wp.vec3f(30.0 * u, 1.5 * v, 0.0), seed, 2))
    elif pattern == CARPET:
        fibre = rough_noise(p / 0.006, seed, 2)
        c = a * (1.0 + 0.35 * fibre + 0.12 * rough_noise(p / 0.15, seed + 4, 2))
        ring = wp.sin(6.2832 * (wp.abs(x) + wp.abs(y)))
        if ring > 0.55:
            c = e * (1.0 + 0.35 * fibre)
    return wp.vec3f(wp.clamp(c[0], 0.004, 0.95), wp.clamp(c[1], 0.004, 0.95), wp.clamp(c[2], 0.004, 0.95))
