"""The bugs that `seed_bugs.py` plants: mistakes that are easily made and hard to see in a picture."""

from typing import NamedTuple

KERNELS = "kernels/oasis_kernels"
GRID = "tests/certify/test_grid.py"
FAMILIES = {
    "rasterization": "rasterization",
    "depth": "depth_map or depth_visibility",
    "faces": "face_rotations",
    "posing": "pose_on_mesh",
}
"""Words of pytest's -k for the tests of an operator."""


class Bug(NamedTuple):
    """One mistake."""

    name: str
    path: str
    old: str
    """Stands there exactly once."""
    new: str
    tests: tuple[str, ...]
    """Arguments of pytest: what has to catch it."""


VECTOR_TESTS = {"depth/buffer.h": "tests/ops/test_visibility_vectors.py"}
"""What holds a file against the generic kernels: bugs that only a filter's doubtful cases show."""


def _in(module: str, operator: str, *bugs: tuple[str, str, str]) -> list[Bug]:
    """Bugs in a file of kernels: (what, old, new). On the CPU C++ does float32, the generic kernels do float64."""
    dtype = "float64" if module.endswith(".py") and module != "constants.py" else "float32"
    tests = (GRID, "-k", f"small_scenes and {dtype} and ({FAMILIES[operator]})")
    if module in VECTOR_TESTS:
        tests = (VECTOR_TESTS[module],)
    return [Bug(f"{module}: {name}", f"{KERNELS}/{module}", old, new, tests) for name, old, new in bugs]


def _of(room: str, tests: str, only: str, name: str, old: str, new: str) -> Bug:
    """A bug in the pipeline: `tests` is a file, `only` words of its test's name."""
    return Bug(f"{room}: {name}", f"src/oasis_warp/{room}.py", old, new, (f"tests/{tests}.py", "-k", only))


def _at(module: str, tests: str, only: str, name: str, old: str, new: str) -> Bug:
    """The same in a file of kernels."""
    return Bug(f"{module}: {name}", f"{KERNELS}/{module}", old, new, (f"tests/{tests}.py", "-k", only))


PIPELINE = [
    _of("avatar/observation", "avatar/test_quality", "projects_to", "the photo read half a pixel off",
        "(2 * uv - 1)[:, None], align_corners=False", "(2 * uv - 1)[:, None], align_corners=True"),
    _of("data/square_crop", "data_stage/test_square_crop", "resampled or sees", "the crop half a pixel off in y",
        "-top * scale + 0.5 * scale - 0.5]", "-top * scale + 0.5 * scale]"),
    _of("estimation/segmentation", "estimation/test_segmentation", "without_the_arm", "the arm taken for hand",
        " & (arm < np.maximum(hand, 0.3))", ""),
    _of("estimation/segmentation", "estimation/test_segmentation", "without_the_arm or edges or slits or finger",
        "the colours' band ten times as wide", "_BAND = 3.0", "_BAND = 30.0"),
    _of("estimation/fit", "estimation/test_fit", "beyond_its_limits", "no lower pose limits",
        "np.maximum(state.angles - self.high, 0) + np.minimum(state.angles - self.low, 0)",
        "np.maximum(state.angles - self.high, 0)"),
    _of("estimation/refine", "estimation/test_surface_points", "step_that_was_taken", "the rotation reversed",
        "state.rotation @ self.start.rotation.T", "self.start.rotation @ state.rotation.T"),
    _of("core/bands", "evaluation/test_picture_metrics", "outline or beside", "what is not skin has weight",
        "(values * weight)", "values"),
    _of("evaluation/kernel_distance", "evaluation/test_picture_metrics", "halves", "pairs of one hand counted",
        "return sums * (1 - np.eye(n_groups))", "return sums"),
    _of("export/splat_formats", "export/test_splat_files", "looks_as", "scales, not their logarithms",
        "splats.scales.log()", "splats.scales"),
    _of("export/splats", "export/test_splat_files", "shapes", "quaternions turned from the wrong side",
        "rotation.multiply(about, gaussians.quats)", "rotation.multiply(gaussians.quats, about)"),
    _of("export/splat_formats", "export/test_splat_files", "shapes", "quaternions wxyz where xyzw belong",
        "largest_component(quats[:, [1, 2, 3, 0]])", "largest_component(quats)"),
    _of("export/surface_mesh", "export/test_skinned_gltf", "clip_ends", "vertices moved by a joint's parent",
        "rig.bones.index(bone)", "max(rig.bones.index(bone) - 1, 0)"),
    _of("hand/webxr_rig", "export/test_skinned_gltf", "clip_ends", "a joint's rotation in the room, not its parent",
        "rotation.from_matrix(upper.mT @ world)", "rotation.from_matrix(world)"),
    _of("export/surface_mesh", "export/test_skinned_gltf", "closed", "faces of left hands inside out",
        'faces.flip(1) if avatar.side == "left" else faces', "faces"),
    _of("export/texture", "export/test_skinned_gltf", "texture", "the texture upside down",
        "1 - hand.uv[:, 1]", "hand.uv[:, 1]"),
    _of("export/hand_parameters", "export/test_formats", "manos", "rotations inverted",
        ".mT @ world[1:]", " @ world[1:].mT"),
    _of("data/splat_files", "export/test_splat_files", "looks_as", "an .spz that is not turned to y down",
        "return means * [1, -1, -1], ", "return means, "),
    _of("motion/motion", "motion/test_motion_file", "tracked", "bones turned against their parents' parent",
        "rotations[:, list(hand.parents[1:])].mT @ rotations[:, 1:]",
        "rotations[:, 1:] @ rotations[:, list(hand.parents[1:])].mT"),
    _of("motion/motion_file", "motion/test_motion_file", "tracked", "quaternions wxyz where xyzw stand",
        "quats[..., [3, 0, 1, 2]]", "quats"),
    _of("motion/bvh", "motion/test_motion_file", "bent_fingers", "the skeleton's rest pose taken for ours",
        "moved @ _shortest(ahead - ours[bone], direction)", "moved"),
    _of("motion/recording", "motion/test_motion_file", "bridged", "gaps filled by the frame before",
        "before + share)", "before)"),
    _of("evaluation/views", "evaluation/test_looks", "outside", "the inside of the wrist taken for skin",
        "silhouette & outside & clear", "silhouette & clear"),
    _of("adaptation/albedo_split", "adaptation/test_albedo_split", "single_gaussians", "marks judged per Gaussian",
        "albedo = trust * torch.lerp(beyond, skin, no_mark)",
        "albedo = torch.lerp(beyond, skin, 1 - mark_probability(beyond))"),
    _of("avatar/vertex_light", "ops/test_vertex_light", "gradient_by", "no gradient of colours by the view",
        "kernels_can_run(on.normals, viewed, *light)", "kernels_can_run(on.normals, *light)"),
    _of("adaptation/smooth_shade", "adaptation/test_smooth_shade", "hide_the_sky", "no shadows beside outlines",
        "torch.lerp(smooth, shadow, covered[:, None])", "smooth"),
    _of("adaptation/photo_view", "adaptation/test_photo_view", "between_the_photos", "photos matched at their pixels",
        "FINER, LARGEST = 2, 768", "FINER, LARGEST = 1, 768"),
    _of("estimation/surface_offsets", "estimation/test_surface_offsets", "stays_closed", "thin slits stay open",
        "_OPAQUE, _OVERLAP = 0.85, 0.3", "_OPAQUE, _OVERLAP = 0.5, 0.0"),
    _of("avatar/vertex_light", "avatar/test_sky", "deep_shade_beside", "a shadow outlives what cast it",
        "change = (on.exposure[..., 0] - seen).clamp_min(0)", "change = 0 * on.exposure[..., 0]"),
    _of("avatar/folds", "avatar/test_folds", "straight_ones", "seen and painted folds swapped",
        "seen, painted = of_photo * (1 - folds.painted), of_straight * folds.painted",
        "seen, painted = of_straight * (1 - folds.painted), of_photo * folds.painted"),
    _of("avatar/creases", "avatar/test_creases", "where_it_is_stretched", "creases go flat where skin is squeezed",
        "(_coarse_areas(posed) / creases.areas).log()", "(creases.areas / _coarse_areas(posed)).log()"),
    _of("avatar/folds", "avatar/test_folds", "paler_and_warmer", "brown spots stay of opened folds",
        "beyond_shallow(beyond, OPEN)", "0 * beyond"),
    _of("avatar/folds", "avatar/test_folds", "stays_straight", "one finger's bend changes the whole back",
        "torch.lerp(*opened.unbind(-2), folds.between)", "opened.amax(-2).amax(-2, keepdim=True)"),
    _of("avatar/sky", "avatar/test_sky", "stiff_hand", "shadows swim while a stiff hand turns",
        "turns = quats[..., mesh.still, :]", "turns = (0 * quats[..., 0, :] + 0.5)"),
    _of("avatar/sky", "avatar/test_sky", "skin_that_touches", "flesh on the wrong side is a black spot",
        "hidden = (inside * closeness)[..., None]", "hidden = closeness[..., None]"),
    _of("hand/contact", "hand/test_contact", "begins_at_the_photos", "lines between fingers appear at once",
        "vertices.shape[:-1])", "vertices.shape[:-1]).sign()"),
    _of("adaptation/reliability", "adaptation/test_unseen_skin", "lies_on_it", "finger tips printed on the palm",
        "before(bent & (finger == number)) > FINGER_GAP", "before(bent & (finger == number)) > BEHIND_GAP"),
    _of("adaptation/reliability", "adaptation/test_unseen_skin", "another_place", "what a pixel is read as ignored",
        "    if reading is None:", "    if reading is not None:"),
    _of("adaptation/adapt", "adaptation/test_adapt", "more_pixels", "fused without resolution",
        "observe_photos(hand, unlit, resolutions or [1.0] * len(crops))",
        "observe_photos(hand, unlit, [1.0] * len(crops))"),
    _of("adaptation/unseen_skin", "adaptation/test_unseen_skin", "no_step_shows", "painted skin not joined to seen",
        "tone.log_skin + form + smooth, bed +", "tone.log_skin + form, bed +"),
    _of("adaptation/unseen_skin", "adaptation/test_unseen_skin", "own_view", "paint over slanted skin",
        "gaussians.shade * beyond.exp()", "gaussians.shade"),
    _of("adaptation/skin_detail", "adaptation/test_skin_detail", "same_detail", "texture coordinates of another corner",
        "uv[uv_faces.flatten()[corners]]", "uv[uv_faces.flatten()[corners - 1]]"),
    _of("network/prior", "network/test_network_prior", "floats", "Gaussians above the surface kept",
        "above.clamp(max=0) * normals", "above * normals"),
    _of("adaptation/prior_guess", "adaptation/test_adapt", "different_light", "the guesses' gains forgotten",
        "_in_one_light([table.colors for table in tables], present)", "[table.colors for table in tables]"),
    _of("editing", "test_editing", "worn_as", "paint under the photo's light",
        "canvas = canvas._replace(image=without_light(avatar.hand, crop, avatar.light).image)", "pass"),
    _of("avatar/quality", "avatar/test_quality", "shares_of_area", "shares of regions count vertices",
        "100 * mean(seen, area * weight)", "100 * mean(seen, weight)"),
    _of("network/heads", "network/test_gaussian_heads", "layers_weights", "the last layer's update halved",
        "_updated(hidden, cache.last, last)", "_updated(hidden, cache.last, (0.5 * last[0], last[1]))"),
    _of("network/heads", "network/test_gaussian_heads", "updates_start", "updates as wide as their outputs ask",
        "/ math.sqrt(inputs)", "/ math.sqrt(outputs)"),
    _of("estimation/keypoints", "estimation/test_landmarks", "camera_of_a_pose", "the centre not shrunk with the photo",
        '"centre", (2,), FOCALS[1] * longer / photo.shrink) * photo.shrink',
        '"centre", (2,), FOCALS[1] * longer / photo.shrink)'),
    _of("synthetic/skin_lines", "synthetic/test_people", "lie_on_the_palm", "creases on the back",
        's[:, None], "palm")', 's[:, None], "back")'),
    _of("cli/render", "cli/test_render_and_animate", "film_in_even_light", "--light even ignored",
        'options.light == "even"', 'options.light == "none"'),
    _of("core/camera", "core/test_camera", "horizon", "azimuth and elevation exchanged",
        "roll @ pan @ tilt", "roll @ tilt @ pan"),
    _of("estimation/fit_quality", "estimation/test_fit", "reaches_a_border", "the right border not looked at",
        "hand[:, 0], hand[:, -1])", "hand[:, 0])"),
    _of("estimation/hand_crop", "data_stage/test_square_crop", "mirrored_photo or wrist_line",
        "a left wrist not mirrored", "image, above = image.flip(1), above.flip(1)", "image = image.flip(1)"),
    _of("ops/_runtime/blend_tiles", "certify/test_grid", "small_scenes and rasterization", "farthest first",
        "torch.argsort(depths.view(-1)[drawn], stable=True)", "torch.argsort(-depths.view(-1)[drawn], stable=True)"),
]  # fmt: skip
SCENE = [
    _at("scene/vertex_light.h", "ops/test_vertex_light", "many_steps", "weak shade stays beside moved fingers",
        "ramp(own + (near - own) * doubtful, other, same)", "ramp(own, other, same)"),
    _at("scene/vertex_light.h", "avatar/test_sky", "finger_that_opens", "a shadow outlives what cast it",
        "    *deep = *deep * ramp(near, other, same);\n", ""),
    _at("scene/gaussian_light.h", "ops/test_gaussian_light", "many_steps", "painted folds open as the photo's do",
        "(first[1] + (second[1] - first[1]) * t) * paint", "(first[0] + (second[0] - first[0]) * t) * paint"),
    _at("scene/sky_light.h", "ops/test_spherical_harmonics", "draw_both", "radiance as blurred as irradiance",
        "h[0] + 1.5f * (h[3]", "h[0] + 1.0f * (h[3]"),
    _at("skinning/contact.cpp", "hand/test_contact", "farther_than_the_limit", "flesh gives way without limit",
        "if (length > give[v]) moved *= give[v] / length;", ""),
    _at("skinning/contact.cpp", "hand/test_contact", "skin_that_faces", "gaps to skin that faces away",
        "(cosine < opposed)", "(cosine > opposed)"),
]  # fmt: skip
STOPS = f"\n{28 * ' '}transmittance[pixel] = -before\n{28 * ' '}stops[pixel] = place"
PIXEL = f"\n{20 * ' '}pixel = (camera * height + y) * width + x"
"""Lines of `blend` that tell it from `weigh` in the same file."""

BUGS = [
    *PIPELINE,
    *SCENE,
    *_in(
        "rasterize/rasterize_forward.py", "rasterization",
        ("pixel centre without 0.5", "type(whole)(0.5) - remainder", "type(whole)(0.0) - remainder"),
        ("the stop draws the last layer", f"if after <= scalar(stop):{STOPS}", f"if before <= scalar(stop):{STOPS}"),
        ("no stop", f"if after <= scalar(stop):{STOPS}", f"if after < scalar(0.0):{STOPS}"),
        ("no cap", f"wp.min(raw, scalar(constants.ALPHA_MAX)){PIXEL}", f"wp.min(raw, scalar(1.0)){PIXEL}"),
    ),
    *_in(
        "rasterize/rasterize_backward.py", "rasterization",
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
        "rasterize/gaussian.py", "rasterization",
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
    ),
    *_in(
        "rasterize/projection.py", "rasterization",
        ("J detached from the gradient of means", "                g_j0 = camera * g_b0\n",
         "                g_j0 = wp.float64(0.0) * g_b0\n"),
        ("norm of the quaternion not differentiated", "vec4((g_unit - wp.dot(g_unit, q) * q) / norm)",
         "vec4(g_unit / norm)"),
        ("low-pass 1 % off", "cov = wp.vec3d(wp.dot(s.m0, s.m0) + eps2d,",
         "cov = wp.vec3d(wp.dot(s.m0, s.m0) + wp.float64(1.01) * eps2d,"),
        ("no near test", "if not (depth >= near and depth <= far and opacity >= alpha_min):",
         "if not (depth <= far and opacity >= alpha_min):"),
        ("a centre on the near plane culled", "if not (depth >= near and", "if not (depth > near and"),
        ("boxes of 2 sigma", "reach = wp.min(extent_sigmas,", "reach = wp.min(wp.float64(2.0),"),
    ),
    *_in(
        "rasterize/projection.cpp", "rasterization",
        ("no near test", "I drawn = (pz >= near) & (pz <= far) & bright;", "I drawn = (pz <= far) & bright;"),
        ("boxes of 2 sigma", "reach = reach + reach < reach_limit ? reach + reach : reach_limit;",
         "reach = reach + reach < 4.0 ? reach + reach : (V)(4.0);"),
    ),
    *_in(
        "rasterize/jacobian.h", "rasterization",
        ("J not clamped", "slope_u = u < k.u_low ? (V)(k.u_low) : u > k.u_high ? (V)(k.u_high) : u;", "slope_u = u;"),
        ("sign of the third column of J", "b0[e] = j0 * (k.r[e] - slope_u * k.r[6 + e]);",
         "b0[e] = j0 * (k.r[e] + slope_u * k.r[6 + e]);"),
    ),
    *_in(
        "rasterize/covariance2d.h", "rasterization",
        ("low-pass 1 % off", "xx = flat_xx + eps2d;", "xx = flat_xx + 1.01 * eps2d;"),
    ),
    *_in(
        "rasterize/projection.h", "rasterization",
        ("one sign in the rotation", "r[1] = two * (x * y - w * z);", "r[1] = two * (x * y + w * z);"),
    ),
    *_in(
        "rasterize/point_gradient.h", "rasterization",
        ("J detached from the gradient of means",
         "const V g_inverse = k.fx * (g_j00 - slope_u * g_j02) + k.fy * (g_j11 - slope_v * g_j12);",
         "const V g_inverse = (V)(0.0);"),
        ("clamped slopes differentiated", "((slope_u == u) & moving ? j0 * g_j02 : (V)(0.0))", "j0 * g_j02"),
    ),
    *_in(
        "rasterize/quaternion_gradient.h", "rasterization",
        ("norm of the quaternion not differentiated",
         "const V along = inverse_norm * (g_w * w + g_x * x + g_y * y + g_z * z),", "const V along = (V)(0.0),"),
    ),
    *_in(
        "constants.py", "rasterization",
        ("threshold 2/255", "ALPHA_MIN = 0.003921568859368563", "ALPHA_MIN = 0.007843137718737125"),
        ("cap 0.99", "ALPHA_MAX = 0.9990000128746033", "ALPHA_MAX = 0.9900000095367432"),
    ),
    *_in(
        "rasterize/strip_lists.cpp", "rasterization",
        ("pixel centre without 0.5", "r[2] = 0.5f - center[2]", "r[2] = 0.f - center[2]"),
    ),
    *_in(
        "rasterize/strip_sort.h", "rasterization",
        ("farthest first", "items[j - 1] > item", "items[j - 1] < item"),
        ("ties in reverse order", "items[j - 1] > item", "items[j - 1] >> 31 >= item >> 31"),
    ),
    *_in(
        "rasterize/strip_fill.h", "rasterization",
        ("depth keys of 11 bits", "((sort_depths[i] - low) >> drop) << 31",
         "((sort_depths[i] - low) >> drop >> 22 << 22) << 31"),
    ),
    *_in(
        "rasterize/strips.cpp", "rasterization",
        ("the stop draws the last layer", "const V weight = ends ? (V)(0.f) : full;", "const V weight = full;"),
    ),
    *_in(
        "rasterize/strip_blend.h", "rasterization",
        ("no stop", "const I ends = drawn & (after <= last());", "const I ends = drawn & (after < 0.f);"),
        ("no cut-off", "const I drawn = (e >= cut()) & (before > 0.f) INSIDE;",
         "const I drawn = (before > 0.f) INSIDE;"),
        ("no cap", "const V alpha = drawn ? (raw < cap() ? raw : cap()) : (V)(0.f);",
         "const V alpha = drawn ? raw : (V)(0.f);"),
    ),
    *_in(
        "rasterize/strips_backward.cpp", "rasterization",
        ("gradient leaks through the cap", "const V q = raw <= cap() ? weight * step : (V)(0.f);",
         "const V q = weight * step;"),
        ("T of the background detached", "behind = fma(g, (V)background[k], behind);", ""),
        ("alpha without gradient", "t[stride + 2 * x + side] = -g_alpha[pixel[side] + x];",
         "t[stride + 2 * x + side] = 0.f;"),
        ("one covariance gradient counts twice", "xy = a * w1 + b * w3", "xy = 2. * (a * w1 + b * w3)"),
        ("what is behind is not updated", "store(t + stride, fma(alpha, step, behind));", ""),
    ),
    *_in(
        "depth/buffer.h", "depth",
        ("farthest in doubt", "if (z > rival ||", "if (z < rival ||"),
    ),
    *_in(
        "depth/visibility.cpp", "depth",
        ("sign of dz", "(depth_of(w, a.z, b.z, c.z) - Z + job.margin)",
         "(Z - depth_of(w, a.z, b.z, c.z) + job.margin)"),
        ("pixel rounded, not floored", "inside ? u : (D)(0.0), I);", "inside ? u + 0.499 : (D)(0.0), I);"),
        ("no near test of points", "const L inside = (Z > near_plane) & (u >= 0.0)", "const L inside = (u >= 0.0)"),
        ("the sigmoid of |x|", "p = soft ? (t >= 0.0 ? part : e * part) : p;", "p = soft ? part : p;"),
        ("background hides", "L seen = inside & __builtin_convertvector(id < 0, L);",
         "L seen = inside & __builtin_convertvector(id < -1, L);"),
        ("sign of the slope", "slope = soft ? -(e * part) * part * per_tau : slope;",
         "slope = soft ? (e * part) * part * per_tau : slope;"),
    ),
    *_in(
        "posing/face_rotation.py", "faces",
        ("one face missing in the vertex mean", "            total += sign * areas[f, 0] * q_face\n",
         "            if j < offsets[v] + 3:\n                total += sign * areas[f, 0] * q_face\n"),
        ("posed areas as weights", "weight = before.area", "weight = after.area"),
        ("no weights", "weight = before.area", "weight = ONE"),
        ("no sign alignment in the mean", "            if wp.dot(q_face, ref) < ZERO:\n                sign = -ONE",
         "            if wp.dot(q_face, ref) < ZERO:\n                sign = ONE"),
        ("area ratio inverted", "return (posed.area + damping) / (rest.area + damping)",
         "return (rest.area + damping) / (posed.area + damping)"),
        ("absolute damping", "damping = DAMPING * rest.longest\n    return", "damping = wp.float64(1e-4)\n    return"),
        ("polar angle of the first edge alone", "length_posed * x - length * x_posed))", "ZERO))"),
    ),
    *_in(
        "runtime/arrays.py", "faces",
        ("third corner never added", "a[i, 6 + k] = a.dtype(corners[2, k] + e2[k])",
         "a[i, 6 + k] = a.dtype(corners[2, k])"),
    ),
    *_in(
        "posing/face.h", "faces",
        ("posed areas as weights", "o.weight = 0.5f * rest.l * rest.y * rest.unit * rest.unit;",
         "o.weight = 0.5f * posed.l * posed.y * posed.unit * posed.unit;"),
        ("area ratio inverted", "o.ratio = rest.point ? one : grown / o.damped;",
         "o.ratio = rest.point ? one : o.damped / grown;"),
    ),
    *_in(
        "posing/face_rotations.cpp", "faces",
        ("no sign alignment", "const V sign = dot4(q, reference) < 0.f ? -one : one;", "const V sign = one;"),
    ),
    *_in(
        "posing/edge_gradients.h", "faces",
        ("area weights not differentiated", "by_rest += p.proper ? g_weight : zero;", ""),
    ),
    *_in(
        "posing/barycentric.py", "posing",
        ("dq and q swapped", "multiply(rotation, row4(quats, i))", "multiply(row4(quats, i), rotation)"),
        ("no sign alignment among the corners", "if wp.dot(q, reference) < ZERO:", "if wp.dot(q, reference) < -ONE:"),
        ("area ratio detached", "return HALF * wp.float64(half_powers) * growth(ratio, half_powers) / ratio",
         "return ZERO"),
        ("third corner left out of the mean", "for k in range(3):\n            mean += b[k] * row3(vertices",
         "for k in range(2):\n            mean += b[k] * row3(vertices"),
    ),
    *_in(
        "posing/mesh_gaussians.cpp", "posing",
        ("dq and q swapped", "product(place.rotation, get4(quats + 4ll * at, count))",
         "product(get4(quats + 4ll * at, count), place.rotation)"),
    ),
    *_in(
        "posing/on_mesh.h", "posing",
        ("no sign alignment", "return dot4(a, reference) < 0.f ? -one : one;", "return one;"),
        ("square root left out", "half_powers == 1 ? root(r) : r;", "r;"),
    ),
]  # fmt: skip
