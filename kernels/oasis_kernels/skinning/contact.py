"""Contact of a posed surface with itself: where skin lies inside other skin, and by how much both give way.

Parts are patches of the surface of some millimetres, 32 a group; a word of bits says which parts of a group. One
thread per part and image: `boxes` of its skin, and of its skin with the flesh under it; `reached`, whether it or one
next to it meets any. One thread per group: `group_boxes`. One per part and group: `meetings`, the parts of the group
that have skin where it has flesh, or the other way round. One thread per vertex: `normals` of what is reached; `find`,
the nearest skin that the vertex faces in those parts; `contacts`, the same again among neighbours of the last one, and
the shift that leads out of it; `spread`, the mean of the shifts around, where `moving` has found that one of these can
have a shift; `closeness`, how near to that skin this leaves the vertex. Normals are those before contact.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

WORD = wp.constant(32)
"""Parts of a group."""
SKIN_LOW, SKIN_HIGH, FLESH_LOW, FLESH_HIGH, FACING = (wp.constant(k) for k in range(5))
"""Columns of what `boxes` writes."""


@wp.func
def area_vector(points: wp.array2d[wp.vec3f], faces: wp.array2d[wp.int32], b: int, f: int):
    a = points[b, faces[f, 0]]
    return wp.cross(points[b, faces[f, 1]] - a, points[b, faces[f, 2]] - a)


@wp.kernel
def boxes(
    first: int,
    points: wp.array2d[wp.vec3f],
    faces: wp.array2d[wp.int32],
    members: wp.array[wp.int32],  # vertices by part
    starts: wp.array[wp.int32],
    samples: wp.array2d[wp.int32],  # some faces of each part
    outward: float,  # -1 where faces wind the other way
    reach: float,  # of the flesh under the skin
    pad: float,  # around it
    out: wp.array3d[wp.vec3f],  # [image, part, column]
):
    i = first + wp.tid()
    b = i // out.shape[1]
    p = i - b * out.shape[1]
    low = points[b, members[starts[p]]]
    high = low
    for e in range(starts[p] + 1, starts[p + 1]):
        x = points[b, members[e]]
        low = wp.min(low, x)
        high = wp.max(high, x)
    total = wp.vec3f()
    for k in range(samples.shape[1]):
        total += area_vector(points, faces, b, samples[p, k])
    facing = outward * wp.normalize(total)
    out[b, p, SKIN_LOW] = low
    out[b, p, SKIN_HIGH] = high
    around = wp.vec3f(pad, pad, pad)
    out[b, p, FLESH_LOW] = wp.min(low, low - reach * facing) - around
    out[b, p, FLESH_HIGH] = wp.max(high, high - reach * facing) + around
    out[b, p, FACING] = facing


@wp.kernel
def group_boxes(
    first: int,
    corners: wp.array3d[wp.vec3f],  # of `boxes`
    out: wp.array3d[wp.vec3f],  # [image, group]: low and high corner of skin and flesh
):
    i = first + wp.tid()
    b = i // out.shape[1]
    g = i - b * out.shape[1]
    low = corners[b, g * WORD, FLESH_LOW]
    high = corners[b, g * WORD, FLESH_HIGH]
    for p in range(g * WORD + 1, wp.min((g + 1) * WORD, corners.shape[1])):
        low = wp.min(low, corners[b, p, FLESH_LOW])
        high = wp.max(high, corners[b, p, FLESH_HIGH])
    out[b, g, 0] = low
    out[b, g, 1] = high


@wp.func
def overlap(low: wp.vec3f, high: wp.vec3f, other_low: wp.vec3f, other_high: wp.vec3f):
    inside = low[0] < other_high[0] and low[1] < other_high[1] and low[2] < other_high[2]
    return inside and high[0] > other_low[0] and high[1] > other_low[1] and high[2] > other_low[2]


@wp.kernel
def meetings(
    first: int,
    corners: wp.array3d[wp.vec3f],
    groups: wp.array3d[wp.vec3f],  # of `group_boxes`
    allowed: wp.array2d[wp.int32],  # [part, group]: bits of the parts that it may touch
    opposed: float,  # cosine of the normals of parts that touch, at most
    out: wp.array3d[wp.int32],  # [image, part, group]
    any_met: wp.array2d[wp.int32],  # 1 where a part has a bit in any group; 0 before
):
    i = first + wp.tid()
    n_groups = out.shape[2]
    row = i // n_groups
    g = i - row * n_groups
    b = row // out.shape[1]
    p = row - b * out.shape[1]
    bits = allowed[p, g]
    met = wp.int32(0)
    if bits != 0:
        low = corners[b, p, SKIN_LOW]
        high = corners[b, p, SKIN_HIGH]
        deep_low = corners[b, p, FLESH_LOW]
        deep_high = corners[b, p, FLESH_HIGH]
        if overlap(deep_low, deep_high, groups[b, g, 0], groups[b, g, 1]):
            for k in range(WORD):
                if (bits >> k) & 1 == 1:
                    q = g * WORD + k
                    if wp.dot(corners[b, p, FACING], corners[b, q, FACING]) < opposed:
                        one = overlap(low, high, corners[b, q, FLESH_LOW], corners[b, q, FLESH_HIGH])
                        if one or overlap(corners[b, q, SKIN_LOW], corners[b, q, SKIN_HIGH], deep_low, deep_high):
                            met = met | (1 << k)
    out[b, p, g] = met
    if met != 0:
        any_met[b, p] = 1  # whichever thread writes it


@wp.kernel
def reached(
    first: int,
    any_met: wp.array2d[wp.int32],  # of `meetings`
    beside: wp.array2d[wp.int32],  # parts next to each part, itself first; -1 fills rows up
    out: wp.array2d[wp.int32],  # 2: it meets others; 1: one beside it does
):
    i = first + wp.tid()
    b = i // out.shape[1]
    p = i - b * out.shape[1]
    found = 2 * any_met[b, p]
    for k in range(1, beside.shape[1]):
        q = beside[p, k]
        if q >= 0:
            found = wp.max(found, any_met[b, q])
    out[b, p] = found


@wp.kernel
def normals(
    first: int,
    points: wp.array2d[wp.vec3f],
    faces: wp.array2d[wp.int32],
    offsets: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    part: wp.array[wp.int32],  # of each vertex
    state: wp.array2d[wp.int32],  # of `reached`
    outward: float,
    out: wp.array2d[wp.vec3f],
):
    i = first + wp.tid()
    b = i // points.shape[1]
    v = i - b * points.shape[1]
    total = wp.vec3f()
    if state[b, part[v]] > 0:
        for e in range(offsets[v], offsets[v + 1]):
            total += area_vector(points, faces, b, entries[e] // 3)
    out[b, v] = outward * wp.normalize(total)


@wp.kernel
def find(
    first: int,
    points: wp.array2d[wp.vec3f],
    normals: wp.array2d[wp.vec3f],
    members: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    part: wp.array[wp.int32],  # of each vertex
    corners: wp.array3d[wp.vec3f],
    met: wp.array3d[wp.int32],
    state: wp.array2d[wp.int32],  # of `reached`
    reach: float,
    opposed: float,  # cosine of the normals of skin that touches, at most
    out: wp.array2d[wp.int32],  # a vertex; -1 for none
):
    i = first + wp.tid()
    b = i // points.shape[1]
    v = i - b * points.shape[1]
    other = wp.int32(-1)
    if state[b, part[v]] == 2:
        x = points[b, v]
        n = normals[b, v]
        nearest = reach * reach
        for g in range(met.shape[2]):
            bits = met[b, part[v], g]
            for byte in range(4):
                eight = (bits >> (8 * byte)) & 255
                if eight != 0:
                    for k in range(8):
                        if (eight >> k) & 1 == 1:
                            p = g * WORD + 8 * byte + k
                            past = wp.max(corners[b, p, SKIN_LOW] - x, x - corners[b, p, SKIN_HIGH])
                            past = wp.max(past, wp.vec3f())
                            if wp.dot(past, past) < nearest:
                                for e in range(starts[p], starts[p + 1]):
                                    j = members[e]
                                    r = points[b, j] - x
                                    distance = wp.dot(r, r)
                                    if distance < nearest:
                                        if wp.dot(n, normals[b, j]) < opposed:
                                            nearest = distance
                                            other = j
    out[b, v] = other


@wp.func
def nearest_now(
    points: wp.array2d[wp.vec3f],
    shifts: wp.array2d[wp.vec3f],
    normals: wp.array2d[wp.vec3f],
    offsets: wp.array[wp.int32],
    neighbours: wp.array[wp.int32],
    opposed: float,
    b: int,
    v: int,
    last: int,
):
    """Of `last` and its neighbours the vertex nearest to v that v faces, after both have moved."""
    x = points[b, v] + shifts[b, v]
    n = normals[b, v]
    other = last
    r = points[b, last] + shifts[b, last] - x
    for e in range(offsets[last], offsets[last + 1]):
        j = neighbours[e]
        s = points[b, j] + shifts[b, j] - x
        if wp.dot(s, s) < wp.dot(r, r):
            if wp.dot(n, normals[b, j]) < opposed:
                other = j
                r = s
    return other


@wp.kernel
def contacts(
    first: int,
    points: wp.array2d[wp.vec3f],
    shifts: wp.array2d[wp.vec3f],  # of the points so far
    normals: wp.array2d[wp.vec3f],
    others: wp.array2d[wp.int32],  # of `find`
    offsets: wp.array[wp.int32],  # rows of neighbours
    neighbours: wp.array[wp.int32],
    give: wp.array[wp.float32],  # how far each vertex can give way
    opposed: float,
    aside: float,
    margin: float,
    out: wp.array2d[wp.vec4f],  # the shift that leads out, and 1 where there is one
):
    i = first + wp.tid()
    b = i // points.shape[1]
    v = i - b * points.shape[1]
    found = wp.vec4f()
    last = others[b, v]
    if last >= 0:
        other = nearest_now(points, shifts, normals, offsets, neighbours, opposed, b, v, last)
        r = points[b, other] + shifts[b, other] - points[b, v] - shifts[b, v]
        m = normals[b, other]
        depth = wp.dot(r, m)
        both = give[v] + give[other]
        if depth > -margin and wp.dot(r, r) - depth * depth < aside * aside and both > 0.0:
            s = (depth + margin) * give[v] / both * m
            found = wp.vec4f(s[0], s[1], s[2], 1.0)
    out[b, v] = found


@wp.kernel
def moving(
    first: int,
    others: wp.array2d[wp.int32],  # of `find`
    offsets: wp.array[wp.int32],  # rows of neighbours
    neighbours: wp.array[wp.int32],
    out: wp.array2d[wp.int32],  # 1 where a vertex or one of its neighbours has another; 0 before
):
    i = first + wp.tid()
    b = i // others.shape[1]
    v = i - b * others.shape[1]
    if others[b, v] >= 0:
        for e in range(offsets[v], offsets[v + 1]):
            out[b, neighbours[e]] = 1  # whichever thread writes it


@wp.kernel
def spread(
    first: int,
    wanted: wp.array2d[wp.vec4f],  # of `contacts`
    shifts: wp.array2d[wp.vec3f],
    moving: wp.array2d[wp.int32],  # of `moving`
    offsets: wp.array[wp.int32],
    neighbours: wp.array[wp.int32],
    weights: wp.array[wp.float32],  # of neighbours
    give: wp.array[wp.float32],
    fades: float,  # share of neighbours in contact below which the shift fades
    out: wp.array2d[wp.vec3f],
):
    i = first + wp.tid()
    b = i // wanted.shape[1]
    v = i - b * wanted.shape[1]
    moved = shifts[b, v]
    if moving[b, v] > 0:
        total = wp.vec3f()
        share = wp.float32(0.0)
        for e in range(offsets[v], offsets[v + 1]):
            s = wanted[b, neighbours[e]]
            share += weights[e] * s[3]
            total += weights[e] * wp.vec3f(s[0], s[1], s[2])
        moved += total / wp.max(share, fades)
        length = wp.length(moved)
        if length > give[v]:
            moved = moved * (give[v] / length)
    out[b, v] = moved


@wp.kernel
def closeness(
    first: int,
    points: wp.array2d[wp.vec3f],
    shifts: wp.array2d[wp.vec3f],
    normals: wp.array2d[wp.vec3f],
    others: wp.array2d[wp.int32],  # of `find`
    offsets: wp.array[wp.int32],
    neighbours: wp.array[wp.int32],
    opposed: float,
    aside: float,  # half the distance between vertices, which is no gap
    width: float,
    out: wp.array2d[wp.float32],  # exp(-gap / width); not changed where a vertex has no other
):
    i = first + wp.tid()
    b = i // points.shape[1]
    v = i - b * points.shape[1]
    last = others[b, v]
    if last >= 0:
        other = nearest_now(points, shifts, normals, offsets, neighbours, opposed, b, v, last)
        r = points[b, other] + shifts[b, other] - points[b, v] - shifts[b, v]
        depth = wp.dot(r, normals[b, other])
        past = wp.sqrt(wp.max(wp.dot(r, r) - depth * depth, 0.0)) - aside
        out[b, v] = wp.exp(-(wp.max(-depth, 0.0) + wp.max(past, 0.0)) / width)
