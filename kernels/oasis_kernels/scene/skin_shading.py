"""Deferred shading of skin and of what is worn on it. One thread per sub-pixel; everything in the camera's frame.

`shade` reads the visibility buffer (face and barycentrics) and the person's texture, and writes incoming diffuse light,
reflectance and mirrored light apart: `scatter` blurs the first over the skin, a pass an axis, with a width of its own
for red, green and blue (light that enters skin comes out some way off), and `resolve` puts them together and averages
the sub-pixels of a pixel.

Relief: the surface gradient of the height map (Mikkelsen 2010) by differences in the texture. Mirrored light: two GGX
lobes for lamps, low-order harmonics of the sky along the mirrored ray.
"""

import warp as wp

from oasis_kernels.runtime.arrays import image_row_column
from oasis_kernels.scene.sky import Lamps, blurred, cosine_lobe, dither, harmonics, lamp_visibility, light_along, vec9

wp.set_module_options({"enable_backward": False})  # fast_math makes NaN of powers: a dot product may exceed 1

SKIN = wp.constant(0)
MATERIAL_WORDS = wp.constant(6)
"""Numbers of a material that is worn: red, green, blue, roughness, metal, cloth."""
CLOTH_CELL = wp.constant(0.0012)
SHEEN = wp.constant(0.028)
"""Reflectance of skin seen straight on."""
WRAP = wp.constant(wp.vec3f(0.22, 0.08, 0.04))
"""Light that scattering carries beyond the terminator, as a share of the cosine."""
PI = wp.constant(3.14159265)

vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec8h = wp.types.vector(length=8, dtype=wp.float16)


@wp.func
def texel(page: wp.array2d[vec8h], x: float, y: float) -> vec8:
    """Bilinear; x and y in texels, centres at .5."""
    u, v = wp.clamp(x - 0.5, 0.0, float(page.shape[1]) - 1.001), wp.clamp(y - 0.5, 0.0, float(page.shape[0]) - 1.001)
    i, j = int(u), int(v)
    a, b = u - float(i), v - float(j)
    out = vec8()
    t0, t1, t2, t3 = page[j, i], page[j, i + 1], page[j + 1, i], page[j + 1, i + 1]
    for c in range(8):
        top = (1.0 - a) * float(t0[c]) + a * float(t1[c])
        low = (1.0 - a) * float(t2[c]) + a * float(t3[c])
        out[c] = (1.0 - b) * top + b * low
    return out


@wp.func
def height(page: wp.array2d[vec8h], x: float, y: float, fold: float, wrinkle: float) -> float:
    """Relief [m]."""
    u, v = wp.clamp(x - 0.5, 0.0, float(page.shape[1]) - 1.001), wp.clamp(y - 0.5, 0.0, float(page.shape[0]) - 1.001)
    i, j = int(u), int(v)
    a, b = u - float(i), v - float(j)
    total = wp.float32(0.0)
    for dj in range(2):
        for di in range(2):
            w = (a if di == 1 else 1.0 - a) * (b if dj == 1 else 1.0 - b)
            t = page[j + dj, i + di]
            total += w * (float(t[3]) + fold * float(t[4]) + wrinkle * float(t[5]))
    return 0.001 * total


@wp.func
def ggx(rough: float, nh: float, nv: float, nl: float) -> float:
    """Distribution times masking over 4 (Walter 2007, Schlick's approximation)."""
    a2 = rough * rough
    d = nh * nh * (a2 - 1.0) + 1.0
    k = (wp.sqrt(rough) + 1.0) * (wp.sqrt(rough) + 1.0) / 8.0
    g = (nv * (1.0 - k) + k) * (nl * (1.0 - k) + k)
    return a2 / (PI * d * d * 4.0 * g)


@wp.kernel
def shade(
    first: int,
    face_ids: wp.array3d[wp.int32],
    barycentrics: wp.array3d[wp.vec3f],
    vertices: wp.array2d[wp.vec3f],
    normals: wp.array2d[wp.vec3f],
    transfer: wp.array3d[wp.float32],  # 9 harmonics, visible share of the sky
    stretch: wp.array3d[wp.float32],  # posed over resting area, [image, vertex, 1]
    faces: wp.array2d[wp.int32],
    materials: wp.array[wp.int32],
    uv: wp.array[wp.vec2f],  # texels
    uv_faces: wp.array2d[wp.int32],
    pages: wp.array[wp.int64],  # address of each image's texture
    page_rows: int,
    page_columns: int,
    worn: wp.array3d[wp.float32],  # [image, material, MATERIAL_WORDS]
    tones: wp.array[wp.vec3f],  # mean reflectance of each image's skin
    sky: wp.array2d[wp.vec3f],
    lamps: Lamps,
    texels_a_pixel: wp.array[wp.float32],
    seeds: wp.array[wp.int32],
    light: wp.array3d[wp.vec3f],
    tone: wp.array3d[wp.vec3f],
    mirrored: wp.array3d[wp.vec3f],
):
    rows, columns = face_ids.shape[1], face_ids.shape[2]
    b, y, x = image_row_column(first + wp.tid(), rows, columns)
    f = face_ids[b, y, x]
    if f < 0:
        return
    w = barycentrics[b, y, x]
    a0, a1, a2 = faces[f, 0], faces[f, 1], faces[f, 2]
    p0, p1, p2 = vertices[b, a0], vertices[b, a1], vertices[b, a2]
    p = w[0] * p0 + w[1] * p1 + w[2] * p2
    n = wp.normalize(w[0] * normals[b, a0] + w[1] * normals[b, a1] + w[2] * normals[b, a2])
    view = -wp.normalize(p)
    open_sky = vec9()
    for h in range(9):
        open_sky[h] = w[0] * transfer[b, a0, h] + w[1] * transfer[b, a1, h] + w[2] * transfer[b, a2, h]
    seen = wp.clamp(w[0] * transfer[b, a0, 9] + w[1] * transfer[b, a1, 9] + w[2] * transfer[b, a2, 9], 0.0, 1.0)
    material = materials[f]
    base = wp.vec3f()
    rough = wp.float32(0.5)
    shine = wp.float32(1.0)
    metal = wp.float32(0.0)
    cavity = wp.float32(1.0)
    m = n
    if material == SKIN:
        page = wp.array(ptr=wp.uint64(pages[b]), shape=(page_rows, page_columns), dtype=vec8h)
        t0, t1, t2 = uv[uv_faces[f, 0]], uv[uv_faces[f, 1]], uv[uv_faces[f, 2]]
        t = w[0] * t0 + w[1] * t1 + w[2] * t2
        area = w[0] * stretch[b, a0, 0] + w[1] * stretch[b, a1, 0] + w[2] * stretch[b, a2, 0]
        fold = wp.clamp(2.2 - 1.3 * area, 0.15, 1.8)
        wrinkle = wp.clamp(0.32 + 5.0 * (0.98 - area), 0.12, 1.5)
        s = texel(page, t[0], t[1])
        base = wp.vec3f(s[0], s[1], s[2])
        # Stretched skin pales, squeezed skin reddens; grooves are dark and warm.
        blush = wp.clamp(0.35 * (1.0 - area), -0.16, 0.22)
        groove = wp.max(-(0.6 * fold * s[4] + 0.55 * wrinkle * s[5]), 0.0)
        base = wp.vec3f(
            base[0] * (1.0 - 0.15 * blush) * wp.exp(-0.75 * groove),
            base[1] * (1.0 - blush) * wp.exp(-1.1 * groove),
            base[2] * (1.0 - 0.7 * blush) * wp.exp(-1.15 * groove),
        )
        rough = s[6]
        shine = s[7]
        e1, e2 = p1 - p0, p2 - p0
        d1, d2 = t1 - t0, t2 - t0
        det = d1[0] * d2[1] - d1[1] * d2[0]
        if wp.abs(det) > 1.0e-9:
            pu = (d2[1] * e1 - d1[1] * e2) / det  # metres a texel
            pv = (d1[0] * e2 - d2[0] * e1) / det
            r1, r2 = wp.cross(pv, n), wp.cross(n, pu)
            volume = wp.dot(pu, r1)
            if wp.abs(volume) > 1.0e-14:
                o = wp.max(0.75, 0.5 * texels_a_pixel[b])
                hu = height(page, t[0] + o, t[1], fold, wrinkle) - height(
                    page, t[0] - o, t[1], fold, wrinkle
                )
                hv = height(page, t[0], t[1] + o, fold, wrinkle) - height(
                    page, t[0], t[1] - o, fold, wrinkle
                )
                gradient = (hu * r1 + hv * r2) / (2.0 * o * volume)
                steep = wp.length(gradient)
                gradient = gradient / (1.0 + 0.5 * steep)
                m = wp.normalize(n - gradient)
                cavity = 1.0 / (1.0 + 1.2 * wp.max(-0.001 * s[3] * 250.0 + groove, 0.0))
    else:
        base = wp.vec3f(worn[b, material, 0], worn[b, material, 1], worn[b, material, 2])
        rough = worn[b, material, 3]
        metal = worn[b, material, 4]
        if wp.dot(n, view) < 0.0:  # the inside of a sleeve
            n = -n
        m = n
        if worn[b, material, 5] > 0.0:
            state = wp.rand_init(seeds[b])
            fibre = wp.noise(state, p / CLOTH_CELL)
            crease = wp.noise(state, p / 0.012)
            g = wp.vec3f(
                wp.noise(state, (p + wp.vec3f(0.002, 0.0, 0.0)) / 0.012) - crease,
                wp.noise(state, (p + wp.vec3f(0.0, 0.002, 0.0)) / 0.012) - crease,
                wp.noise(state, (p + wp.vec3f(0.0, 0.0, 0.002)) / 0.012) - crease,
            )
            m = wp.normalize(
                n + 0.7 * g + 0.25 * wp.vec3f(fibre, wp.noise(state, p / CLOTH_CELL + wp.vec3f(9.0, 0.0, 0.0)), 0.0)
            )
            base = base * (1.0 + 0.25 * fibre)
            shine = wp.float32(0.3)
    film = wp.normalize(0.5 * n + 0.5 * m)  # the film of oil lies smoother than the skin
    nv = wp.max(wp.dot(film, view), 0.05)
    flat = cosine_lobe(n)
    bumped = cosine_lobe(m)
    diffuse = wp.vec3f()
    plain = light_along(sky, b, flat)
    tilted = light_along(sky, b, bumped)
    under = light_along(sky, b, open_sky)
    for c in range(3):
        diffuse[c] = wp.max(under[c], 0.01) * wp.clamp(wp.max(tilted[c], 0.02) / wp.max(plain[c], 0.02), 0.5, 1.6)
    straight = SHEEN * shine * (1.0 - metal)
    f0 = wp.vec3f(straight, straight, straight) + metal * base
    gloss = wp.vec3f()
    angle = dither(x, y)
    for lamp in range(lamps.positions.shape[1]):
        color = lamps.colors[b, lamp]
        if color[0] + color[1] + color[2] > 0.0:
            to = lamps.positions[b, lamp] - p
            distance = wp.length(to)
            d = to / distance
            fall = lamps.ranges[b, lamp] / distance
            color = color * (fall * fall)
            spread = lamps.spreads[b, lamp]
            facing = wp.dot(n, d)
            share = wp.float32(0.0)
            if facing > -0.25:
                share = lamp_visibility(lamps, b, lamp, p + 0.0012 * n, n, angle, 0.0012)
            if share > 0.0:
                nl = wp.dot(m, d)
                for c in range(3):
                    wrap = WRAP[c] if material == SKIN else 0.0
                    diffuse[c] = diffuse[c] + share * color[c] * wp.max((nl + wrap) / (1.0 + wrap), 0.0)
                if nl > 0.0:
                    middle = wp.normalize(view + d)
                    nh, vh = wp.clamp(wp.dot(film, middle), 0.0, 1.0), wp.clamp(wp.dot(view, middle), 0.0, 1.0)
                    edge = wp.pow(1.0 - vh, 5.0) * wp.max(0.28 - 0.2 * rough, 0.0)
                    lobes = wp.float32(0.0)
                    for k in range(2):
                        r = rough if k == 0 else 0.55 * rough
                        wide = r + 0.35 * spread
                        lobes += (
                            (0.7 if k == 0 else 0.3)
                            * ggx(wide * wide, nh, nv, wp.max(nl, 0.02))
                            * (r / wide)
                            * (r / wide)
                        )
                    for c in range(3):
                        gloss[c] = (
                            gloss[c] + share * color[c] * PI * lobes * nl * (f0[c] + (1.0 - f0[c]) * edge) * cavity
                        )
    hidden = 1.0 - seen
    for c in range(3):  # one more bounce off skin: gaps between fingers are warm, not black
        own = tones[b][c]
        diffuse[c] = diffuse[c] + hidden * own * plain[c] * 0.4 / (1.0 - hidden * own)
    back = 2.0 * wp.dot(film, view) * film - view
    ahead = light_along(sky, b, blurred(harmonics(back), 1.0 - 0.55 * rough))
    grazing = wp.pow(1.0 - nv, 5.0) * wp.max(0.20 * (1.0 - rough), 0.0)
    for c in range(3):
        gloss[c] = (
            gloss[c] + (0.3 * f0[c] * (1.0 + 3.0 * metal) + (1.0 - f0[c]) * grazing) * ahead[c] * seen * seen * cavity
        )
    light[b, y, x] = diffuse
    tone[b, y, x] = base * (1.0 - metal)
    mirrored[b, y, x] = gloss


@wp.kernel
def scatter(
    first: int,
    face_ids: wp.array3d[wp.int32],
    depths: wp.array3d[wp.float32],
    materials: wp.array[wp.int32],
    focals: wp.array[wp.float32],  # of the sub-pixels
    widths: wp.vec3f,  # standard deviation of each colour [m]
    reach: float,  # depth over which light does not leap [m]
    vertical: int,
    light: wp.array3d[wp.vec3f],
    out: wp.array3d[wp.vec3f],
):
    rows, columns = face_ids.shape[1], face_ids.shape[2]
    b, y, x = image_row_column(first + wp.tid(), rows, columns)
    f = face_ids[b, y, x]
    if f < 0:
        return
    if materials[f] != SKIN:
        out[b, y, x] = light[b, y, x]
        return
    z = depths[b, y, x]
    scale = focals[b] / z
    step = wp.max(1, int(0.5 * widths[0] * scale + 0.5))
    dx = 0 if vertical == 1 else step
    dy = step if vertical == 1 else 0
    total = light[b, y, x]
    weight = wp.vec3f(1.0, 1.0, 1.0)
    for k in range(-4, 5):
        u, v = x + k * dx, y + k * dy
        if k != 0 and u >= 0 and u < columns and v >= 0 and v < rows:
            g = face_ids[b, v, u]
            if g >= 0:
                if materials[g] == SKIN:
                    away = (depths[b, v, u] - z) / reach
                    near = wp.exp(-away * away)
                    mm = float(k * step) / scale
                    other = light[b, v, u]
                    for c in range(3):
                        q = mm / widths[c]
                        share = near * wp.exp(-0.5 * q * q)
                        total[c] = total[c] + share * other[c]
                        weight[c] = weight[c] + share
    out[b, y, x] = wp.cw_div(total, weight)


@wp.kernel
def resolve(
    first: int,
    face_ids: wp.array3d[wp.int32],
    depths: wp.array3d[wp.float32],
    materials: wp.array[wp.int32],
    n_hand_faces: int,
    ring: int,
    light: wp.array3d[wp.vec3f],
    tone: wp.array3d[wp.vec3f],
    mirrored: wp.array3d[wp.vec3f],
    color: wp.array3d[wp.vec3f],  # multiplied by alpha
    alpha: wp.array3d[wp.float32],
    mask: wp.array3d[wp.float32],
    depth: wp.array3d[wp.float32],
):
    rows, columns = color.shape[1], color.shape[2]
    b, y, x = image_row_column(first + wp.tid(), rows, columns)
    n = face_ids.shape[1] // rows
    total = wp.vec3f()
    covered = wp.float32(0.0)
    hand = wp.float32(0.0)
    nearest = float(wp.inf)
    for v in range(y * n, y * n + n):
        for u in range(x * n, x * n + n):
            f = face_ids[b, v, u]
            if f >= 0:
                total += wp.cw_mul(tone[b, v, u], light[b, v, u]) + mirrored[b, v, u]
                covered += 1.0
                nearest = wp.min(nearest, depths[b, v, u])
                if f < n_hand_faces or materials[f] == ring:
                    hand += 1.0
    share = 1.0 / float(n * n)
    color[b, y, x] = total * share
    alpha[b, y, x] = covered * share
    mask[b, y, x] = hand * share
    depth[b, y, x] = nearest
