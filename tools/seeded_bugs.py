"""The bugs that `seed_bugs.py` plants: mistakes that are easily made and hard to see in a picture."""

from typing import NamedTuple

KERNELS = "kernels/oasis_kernels"
GRID = "tests/certify/test_grid.py"
TESTS = {
    "rasterization": [GRID, "-k", "rasterization and scenes_of_the_grid"],
    "depth": [GRID, "-k", "depth and scenes_of_the_grid"],
    "faces": [GRID, "-k", "face_rotations and scenes_of_the_grid"],
    "posing": [GRID, "-k", "pose_on_mesh and scenes_of_the_grid"],
}
"""The tests that have to catch the bugs of an operator: arguments of pytest."""


class Bug(NamedTuple):
    """One mistake."""

    name: str
    operator: str
    paths: tuple[str, ...]
    """Files in which `old` stands exactly once each."""
    old: str
    new: str


def _in(module: str, operator: str, *bugs: tuple[str, str, str]) -> list[Bug]:
    return [Bug(f"{module}: {name}", operator, (f"{KERNELS}/{module}.py",), old, new) for name, old, new in bugs]


BUGS = [
    *_in(
        "rasterize_forward", "rasterization",
        ("pixel centre without 0.5", "type(whole)(0.5) - remainder", "type(whole)(0.0) - remainder"),
        ("the stop draws the last layer", "                            if after <= scalar(constants.TRANSMITTANCE_STOP):",
         "                            if before <= scalar(constants.TRANSMITTANCE_STOP):"),
        ("no stop", "if after <= scalar(constants.TRANSMITTANCE_STOP):", "if after < scalar(0.0):"),
        ("no cap", "alpha = wp.min(opacity * falloff(-sigma), scalar(constants.ALPHA_MAX))",
         "alpha = wp.min(opacity * falloff(-sigma), scalar(1.0))"),
    ),
    *_in(
        "rasterize_backward", "rasterization",
        ("gradient leaks through the cap", "if raw <= scalar(constants.ALPHA_MAX):", "if raw <= scalar(2.0):"),
        ("T of the background detached", "behind[pixel] = wp.dot(g, background) - g_alpha[pixel]",
         "behind[pixel] = -g_alpha[pixel]"),
        ("alpha without gradient", "behind[pixel] = wp.dot(g, background) - g_alpha[pixel]",
         "behind[pixel] = wp.dot(g, background)"),
        ("no gradient of the background", "g_background += g * transmittance[pixel]",
         "g_background += g * scalar(0.0)"),
        ("covariance gradient counts xy twice", "wp.vec3d(half * xx, xy, half * yy)",
         "wp.vec3d(half * xx, wp.float64(2.0) * xy, half * yy)"),
        ("opacity gradient is of its logarithm", "g_opacity = m[0] / wp.float64(opacities[index])", "g_opacity = m[0]"),
    ),
    *_in(
        "gaussian", "rasterization",
        ("R of the view transposed", "s.b0 = wp.transpose(camera) * s.j0", "s.b0 = camera * s.j0"),
        ("sign of the third column of J", "s.j1 = wp.vec3d(zero, fy / depth, -fy * v / depth)",
         "s.j1 = wp.vec3d(zero, fy / depth, fy * v / depth)"),
        ("J not clamped", "return wp.clamp(slope, low, high), inside", "return slope, inside"),
        ("quaternion conjugated",
         "    w, x, y, z = q[0], q[1], q[2], q[3]\n    return wp.mat33d(",
         "    w, x, y, z = q[0], -q[1], -q[2], -q[3]\n    return wp.mat33d("),
        ("quaternion xyzw",
         "    w, x, y, z = q[0], q[1], q[2], q[3]\n    return wp.mat33d(",
         "    w, x, y, z = q[3], q[0], q[1], q[2]\n    return wp.mat33d("),
        ("sign of the conic's off-diagonal", "return wp.vec4d(ONE / wp.sqrt(xx), zero, -k * xy / xx, k)",
         "return wp.vec4d(ONE / wp.sqrt(xx), zero, k * xy / xx, k)"),
        ("determinant a c - b b of needles", "return wp.dot(normal, normal) + eps2d",
         "return wp.dot(m0, m0) * wp.dot(m1, m1) - wp.dot(m0, m1) * wp.dot(m0, m1) + eps2d"),
    ),
    *_in(
        "projection", "rasterization",
        ("J detached from the gradient of means", "                g_j0 = camera * g_b0\n",
         "                g_j0 = wp.float64(0.0) * g_b0\n"),
        ("norm of the quaternion not differentiated", "vec4((g_unit - wp.dot(g_unit, q) * q) / norm)",
         "vec4(g_unit / norm)"),
        ("low-pass 1 % off", "cov = wp.vec3d(wp.dot(s.m0, s.m0) + eps2d, wp.dot(s.m0, s.m1), wp.dot(s.m1, s.m1) + eps2d)",
         "cov = wp.vec3d(wp.dot(s.m0, s.m0) + wp.float64(1.01) * eps2d, wp.dot(s.m0, s.m1), wp.dot(s.m1, s.m1) + eps2d)"),
        ("no near test", "if not (depth >= near and depth <= far and opacity >= alpha_min):",
         "if not (depth <= far and opacity >= alpha_min):"),
        ("a centre on the near plane culled", "if not (depth >= near and", "if not (depth > near and"),
        ("boxes of 2 sigma", "reach = wp.min(extent_sigmas,", "reach = wp.min(wp.float64(2.0),"),
    ),
    *_in(
        "constants", "rasterization",
        ("threshold 2/255", "ALPHA_MIN = 0.003921568859368563", "ALPHA_MIN = 0.007843137718737125"),
        ("cap 0.99", "ALPHA_MAX = 0.9990000128746033", "ALPHA_MAX = 0.9900000095367432"),
    ),
    *_in(
        "tiles", "rasterization",
        ("farthest first", "index = order[rank]", "index = order[n_drawn - 1 - rank]"),
    ),
    *_in(
        "strips_binning", "rasterization",
        ("pixel centre without 0.5", "r[2] = 0.5f - center[2]", "r[2] = 0.f - center[2]"),
        ("farthest first", "items[j - 1] > item", "items[j - 1] < item"),
        ("ties in reverse order", "items[j - 1] > item", "items[j - 1] >> 31 >= item >> 31"),
        ("depth keys of 11 bits", "((depths[i] - low) >> drop) << 31", "((depths[i] - low) >> drop >> 22 << 22) << 31"),
    ),
    *_in(
        "strips_forward", "rasterization",
        ("the stop draws the last layer", "const V weight = ends ? (V)(0.f) : full;", "const V weight = full;"),
        ("no stop", "const I ends = drawn & (after <= @STOP@);", "const I ends = drawn & (after < 0.f);"),
        ("no cut-off", "const I drawn = (e >= @CUT@) & (before > 0.f)@INSIDE@;",
         "const I drawn = (before > 0.f)@INSIDE@;"),
        ("no cap", "const V alpha = drawn ? (raw < @CAP@ ? raw : (V)@CAP@) : (V)(0.f);",
         "const V alpha = drawn ? raw : (V)(0.f);"),
    ),
    *_in(
        "strips_backward", "rasterization",
        ("gradient leaks through the cap", "const V q = raw <= @CAP@ ? weight * step : (V)(0.f);",
         "const V q = weight * step;"),
        ("T of the background detached", "behind = fma(g, (V)background[k], behind);", ""),
        ("alpha without gradient", "t[stride + 2 * x + side] = -g_alpha[pixel + x];",
         "t[stride + 2 * x + side] = 0.f;"),
        ("one covariance gradient counts twice", "xy = a * w1 + b * w3", "xy = 2. * (a * w1 + b * w3)"),
        ("what is behind is not updated", "store(t + stride, fma(alpha, step, load(t + stride)));", ""),
    ),
    *_in(
        "face_rotation", "faces",
        ("one face missing in the vertex mean", "            q_face = unit(face_quats, f)\n            sign = ONE",
         "            if j > offsets[v] + 3:\n                continue\n            q_face = unit(face_quats, f)\n            sign = ONE"),
        ("posed areas as weights", "weight = before.area", "weight = after.area"),
        ("no weights", "weight = before.area", "weight = ONE"),
        ("no sign alignment in the mean", "            if wp.dot(q_face, ref) < ZERO:\n                sign = -ONE",
         "            if wp.dot(q_face, ref) < ZERO:\n                sign = ONE"),
        ("area ratio inverted", "return (posed.area + damping) / (rest.area + damping)",
         "return (rest.area + damping) / (posed.area + damping)"),
        ("absolute damping", "damping = DAMPING * rest.longest\n    return", "damping = wp.float64(1e-4)\n    return"),
        ("polar angle of the first edge alone", "length_posed * x - length * x_posed))", "ZERO))"),
        ("third corner never added", "rows[f, 6 + k] = rows.dtype(e2[k])", "rows[f, 6 + k] = rows.dtype(ZERO)"),
    ),
    *_in(
        "face_rotation_vectors", "faces",
        ("posed areas as weights", "o.weight = 0.5f * rest.l * rest.y * rest.unit * rest.unit;",
         "o.weight = 0.5f * posed.l * posed.y * posed.unit * posed.unit;"),
        ("no sign alignment", "const V sign = dot4(q, reference) < 0.f ? -one : one;", "const V sign = one;"),
        ("area ratio inverted", "o.ratio = rest.point ? one : grown / damped;",
         "o.ratio = rest.point ? one : damped / grown;"),
        ("area weights not differentiated", "by_rest += p.proper ? g_weight : zero;", ""),
    ),
    *_in(
        "barycentric", "posing",
        ("dq and q swapped", "turned = multiply(mix(f, faces, b, vertex_quats).unit, row4(quats, i))",
         "turned = multiply(row4(quats, i), mix(f, faces, b, vertex_quats).unit)"),
        ("no sign alignment among the corners", "    if wp.dot(q, reference) < ZERO:\n        return -ONE\n",
         "    if wp.dot(q, reference) < ZERO:\n        return ONE\n"),
        ("area ratio detached", "slope = growth_slope(ratio, half_powers)", "slope = ZERO"),
        ("third corner left out of the mean", "    for k in range(3):\n        mean += b[k] * row3(vertices, faces[f, k])",
         "    for k in range(2):\n        mean += b[k] * row3(vertices, faces[f, k])"),
    ),
    *_in(
        "barycentric_vectors", "posing",
        ("dq and q swapped", "put4(floats(11) + 4ll * i, count, product(turn, get4(quats + 4ll * i, count)));",
         "put4(floats(11) + 4ll * i, count, product(get4(quats + 4ll * i, count), turn));"),
        ("no sign alignment", "return dot4(a, reference) < 0.f ? -one : one;", "return one;"),
        ("square root left out", "half_powers == 1 ? root(r) : r;", "r;"),
    ),
]  # fmt: skip
