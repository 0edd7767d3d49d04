"""No argument of an operator crashes it, hangs it, or turns into NaN without a word; what is refused, and how."""

import hostile_arguments
import numpy as np
import pytest
import torch
from operator_calls import calls, mesh
from rasterization_scenes import ordinary_scene

from oasis_warp import ops
from oasis_warp.ops import DECLARATIONS, rasterization
from oasis_warp.ops._runtime import blend_tiles
from oasis_warp.ops.checks import check_choice, check_finite, check_float, check_index, check_positive, check_shape

pytestmark = pytest.mark.usefixtures("as_shipped")


def test_one_letter_means_one_size_over_several_arguments():
    sizes = {}
    check_shape("quats", torch.zeros(3, 4), "N", 4, sizes=sizes)
    with pytest.raises(ValueError, match=r"scales: expected shape \[3, 3\], got \[2, 3\]"):
        check_shape("scales", torch.zeros(2, 3), "N", 3, sizes=sizes)


def test_another_number_of_axes_is_refused_with_the_hint():
    with pytest.raises(ValueError, match=r"quats: expected shape \[N, 4\], got \[4\]\. Quaternions are wxyz\."):
        check_shape("quats", torch.zeros(4), "N", 4, hint="Quaternions are wxyz.")


def test_something_that_is_no_tensor_is_refused():
    with pytest.raises(TypeError, match="means: expected a torch.Tensor, got list"):
        check_shape("means", [[0, 0, 0]], "N", 3)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e20])
def test_values_that_are_not_finite_are_counted_and_named(bad):
    tensor = torch.zeros(5)
    tensor[3] = bad
    with pytest.raises(ValueError, match="opacities: expected finite values .* 1 of 5 that are not"):
        check_finite(means=torch.zeros(2, 3), opacities=tensor)


def test_none_and_empty_tensors_are_finite():
    check_finite(means=torch.zeros(0, 3), backgrounds=None)


def test_half_precision_is_refused():
    with pytest.raises(ValueError, match="means: expected float32 or float64, got float16"):
        check_float("means", torch.zeros(1, dtype=torch.float16))


def test_two_dtypes_in_one_call_are_refused():
    with pytest.raises(ValueError, match="scales: expected torch.float32"):
        check_float("scales", torch.zeros(1, dtype=torch.float64), like=torch.zeros(1))


@pytest.mark.parametrize("bad", [-1, 7])
def test_an_index_out_of_range_is_refused(bad):
    with pytest.raises(ValueError, match=r"faces: expected indices in 0 \.\. 6 \(7 vertices\)"):
        check_index("faces", torch.tensor([[0, bad, 1]]), 7, "vertices")


def test_an_unknown_choice_is_refused_with_the_list():
    with pytest.raises(ValueError, match="render_mode: expected one of 'RGB', 'D', got 'XYZ'"):
        check_choice("render_mode", "XYZ", ["RGB", "D"])


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_a_number_that_is_not_positive_is_refused(bad):
    with pytest.raises(ValueError, match="tau: expected a positive finite number"):
        check_positive("tau", bad)


POISON = float("nan"), float("inf"), -float("inf"), 1e30


@pytest.fixture
def call():
    scene = ordinary_scene(0)
    arguments = {
        "means": scene.means, "quats": scene.quats, "scales": scene.scales, "opacities": scene.opacities,
        "colors": scene.colors, "viewmats": scene.viewmats, "Ks": scene.Ks, "width": 37, "height": 29,
        "backgrounds": scene.backgrounds,
    }  # fmt: skip

    def change(**changes):
        return rasterization(**{**arguments, **changes})

    change.arguments = arguments
    return change


def test_validate_false_skips_the_look_at_values(call):
    colors = call.arguments["colors"].clone()
    colors[0, 0] = float("nan")
    image, _, _ = call(colors=colors, validate=False)
    assert image[..., 0].isnan().any() and not image[..., 1:].isnan().any()


@pytest.mark.parametrize("value", POISON)
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "viewmats", "Ks"])
def test_unchecked_values_that_are_not_finite_do_not_reach_other_gaussians(name, value, call):
    bad = call.arguments[name].clone().double()
    bad.view(-1)[1] = value
    doubles = {k: v.double() for k, v in call.arguments.items() if isinstance(v, torch.Tensor)}
    for precision in (torch.float32, torch.float64):
        arguments = {k: v.to(precision) for k, v in {**doubles, name: bad}.items()}
        image, alphas, _ = call(**arguments, validate=False)
        assert torch.isfinite(image).all() and torch.isfinite(alphas).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quats": torch.zeros(59, 4)}, r"quats: expected shape \[60, 4\], got \[59, 4\]. One wxyz row"),
        ({"colors": torch.zeros(1, 60, 3)}, r"colors: expected shape \[2, 60, D\], got \[1, 60, 3\]"),
        ({"colors": torch.zeros(60, 33), "backgrounds": None}, r"colors: expected 1 to 32 channels, got 33"),
        ({"colors": torch.zeros(60, 0), "backgrounds": None}, r"colors: expected 1 to 32 channels, got 0"),
        ({"viewmats": torch.eye(4)}, r"viewmats: expected shape \[C, 4, 4\], got \[4, 4\]. A single camera"),
        ({"quats": torch.zeros(60, 4)}, r"quats: expected nonzero rows, got 60 zero rows"),
        ({"opacities": torch.full((60,), 1.5)}, r"opacities: expected values in \[0, 1\], got 1.5 to 1.5. Logits"),
        ({"opacities": torch.full((60,), -0.5)}, r"opacities: expected values in \[0, 1\], got -0.5"),
        ({"Ks": torch.zeros(2, 3, 3)}, r"Ks: expected focal lengths other than 0"),
        ({"width": 0}, r"width: expected a whole number of pixels from 1 to 8388608, got 0"),
        ({"height": -3}, r"height: expected a whole number of pixels from 1 to 8388608, got -3"),
        ({"height": 2.0}, r"height: expected a whole number of pixels from 1 to 8388608, got 2.0"),
        ({"tile_size": 0}, r"tile_size: expected a whole number of pixels"),
        ({"width": 2**16, "height": 2**15}, r"width: expected at most 2147483647 pixels .* got 2 x 32768 x 65536"),
        ({"near_plane": 0.0}, r"near_plane: expected a positive finite number, got 0.0"),
        ({"far_plane": 0.001}, r"far_plane: expected more than near_plane, 0.01, got 0.001"),
        ({"eps2d": -0.1}, r"eps2d: expected a finite variance, at least 0, got -0.1"),
        ({"eps2d": float("nan")}, r"eps2d: expected a finite variance"),
        ({"radius_clip": float("nan")}, r"radius_clip: expected a number of pixels, at least 0, got nan"),
        ({"render_mode": "depth"}, r"render_mode: expected one of 'RGB', 'D', 'ED', 'RGB\+D', 'RGB\+ED', got 'depth'"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused_with_what_was_expected(changes, message, call):
    with pytest.raises(ValueError, match="^" + message):
        call(**changes)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sparse_grad", True), ("distributed", True),
        ("with_ut", True), ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(2, 6)), ("tangential_coeffs", torch.zeros(2, 2)),
        ("thin_prism_coeffs", torch.zeros(2, 4)), ("ftheta_coeffs", object()), ("rolling_shutter", "LEFT_TO_RIGHT"),
        ("viewmats_rs", torch.zeros(2, 4, 4)),
    ],
)  # fmt: skip
def test_arguments_of_gsplat_that_are_not_built_in_are_refused_by_name(name, value, call):
    with pytest.raises(ValueError, match=rf"^{name}: expected .* Not supported in this version\. "):
        call(**{name: value})


def test_arguments_of_gsplat_at_their_defaults_change_nothing(call):
    plain = call()[0]
    defaults = {
        "sh_degree": None, "packed": True, "sparse_grad": False, "absgrad": False, "rasterize_mode": "classic",
        "channel_chunk": 32, "distributed": False, "camera_model": "pinhole", "segmented": False,
        "with_ut": False, "with_eval3d": False, "radial_coeffs": None, "tangential_coeffs": None,
        "thin_prism_coeffs": None, "ftheta_coeffs": None, "viewmats_rs": None,
    }  # fmt: skip
    assert torch.equal(call(**defaults)[0], plain)
    assert torch.equal(call(packed=False, segmented=True, channel_chunk=8)[0], plain)


def test_positions_of_the_arguments_are_those_of_gsplat(call):
    a = call.arguments
    first = [a[k] for k in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")]
    by_position = rasterization(*first, 0.02, 1e4, 0.0, 0.4, None, False, 8, a["backgrounds"], "RGB+D")
    by_name = call(near_plane=0.02, far_plane=1e4, eps2d=0.4, tile_size=8, render_mode="RGB+D")
    assert torch.equal(by_position[0], by_name[0])


def test_saved_tensors_that_were_copied_are_refused(call):
    means = call.arguments["means"].clone().requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(torch.clone, lambda tensor: tensor):
        image, _, _ = call(means=means)
    with pytest.raises(RuntimeError, match="rasterization: expected the tensors that it saved, got copies"):
        image.sum().backward()


N_CALLS = 150


@pytest.mark.filterwarnings("ignore")  # torch's, of odd tensors
def test_a_hostile_call_gives_finite_results_or_one_sentence():
    sound, wrong, kinds = hostile_arguments.bases(), [], set()
    for seed in range(N_CALLS):
        name, arguments, changed = hostile_arguments.hostile_call(seed, sound)
        kind, detail = hostile_arguments.outcome(name, arguments)
        kinds.add(kind)
        if detail:
            wrong.append((seed, name, changed, kind, detail))
    assert not wrong and kinds == {"result", "refusal"}


def arguments_of(name, **which):
    return next(dict(arguments) for operator, arguments in hostile_arguments.bases() if operator == name) | which


@pytest.mark.parametrize("name", ["rasterization", "blend_weights"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tile_size", [2**31, 2**32 + 16, 2**63])
def test_a_tile_size_that_no_kernel_can_count_is_refused(name, dtype, tile_size):
    # In float64 it wrote over the heap.
    arguments = {
        key: value.to(dtype) if isinstance(value, torch.Tensor) else value for key, value in arguments_of(name).items()
    }
    with pytest.raises(ValueError, match="^tile_size: expected a whole number of pixels from 1 to 8388608"):
        getattr(ops, name)(**arguments, tile_size=tile_size)


@pytest.mark.parametrize("validate", [True, False])
@pytest.mark.parametrize("bad", [2**32, 2**32 + 1, -2, 25, -(2**63)])
def test_a_points_vertex_that_does_not_exist_is_always_refused(bad, validate):
    # 2^32 became vertex 0, and with `validate=False` nobody looked.
    arguments = arguments_of("depth_visibility", validate=validate)
    arguments["point_vertices"] = arguments["point_vertices"].clone()
    ops.depth_visibility(**arguments)
    arguments["point_vertices"][0] = bad
    with pytest.raises(ValueError, match=r"^point_vertices: expected indices in -1 .. 24 \(25 vertices, or -1"):
        ops.depth_visibility(**arguments)


@pytest.mark.parametrize("change", ["NumPy", "torch", "memory"])
def test_indices_are_looked_at_again_when_their_memory_changes(change):
    rest, posed, faces = mesh(3, 4, torch.float64)
    faces = torch.from_numpy(faces.numpy().copy()) if change == "NumPy" else faces.clone()
    before = ops.face_rotations(rest, posed, faces)
    if change == "NumPy":
        faces.numpy()[0] = 0, 7, 24
    elif change == "torch":
        faces[0] = torch.tensor([0, 7, 24])
    else:
        faces.data = faces.data[:-1].clone()
    after = ops.face_rotations(rest, posed, faces)
    fresh = ops.face_rotations(rest, posed, faces.clone())
    assert all(torch.equal(a, b) for a, b in zip(after, fresh, strict=True))
    assert after.face_quats.shape != before.face_quats.shape or not torch.equal(after.face_quats, before.face_quats)
    faces.numpy()[0] = 0, 7, 25
    with pytest.raises(ValueError, match="^faces: expected indices in 0 .. 24"):
        ops.face_rotations(rest, posed, faces)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_values_that_no_kernel_reads_are_checked_too(bad):
    made = calls()
    harmonics, skinned = made["rasterization harmonics"].arguments, made["skin poses"].arguments
    colors, transforms = harmonics["colors"].clone(), skinned["transforms"].clone()
    colors[0, -1] = bad
    with pytest.raises(ValueError, match="^colors: expected finite"):
        ops.rasterization(**harmonics | {"colors": colors})
    # A constant of -inf became black.
    colors[0, -1], colors[0, 0] = 0, -float("inf")
    with pytest.raises(ValueError, match="^colors: expected finite"):
        ops.rasterization(**harmonics | {"colors": colors})
    transforms[0, 0, 3, 3] = bad
    with pytest.raises(ValueError, match="^transforms: expected finite"):
        ops.skin(**skinned | {"transforms": transforms})
    painted = arguments_of("blend_colors")
    painted["colors"] = painted["colors"].clone()
    painted["colors"][-1, -1] = bad
    with pytest.raises(ValueError, match="^colors: expected finite"):
        ops.blend_colors(**painted)


@pytest.mark.parametrize("name", DECLARATIONS)
def test_what_is_no_tensor_is_refused_by_name_as_a_type_error(name):
    for key in DECLARATIONS[name].inputs:
        arguments = arguments_of(name)
        if not isinstance(arguments.get(key), torch.Tensor):
            continue
        for bad in (np.zeros(3), [1.0], "x", arguments[key].to_sparse()):
            with pytest.raises(TypeError, match=f"^{key}: expected a (torch.Tensor|dense tensor), got "):
                DECLARATIONS[name].function(**arguments | {key: bad})


@pytest.mark.parametrize("fault", ["type", "values", "focal length"])
def test_blend_weights_names_its_own_arguments(fault):
    arguments = arguments_of("blend_weights")
    bad = {"viewmat": arguments["viewmat"].double()} if fault == "type" else {"K": torch.zeros(3, 3)}
    if fault == "values":
        bad = {"viewmat": torch.full((4, 4), torch.inf)}
    with pytest.raises(ValueError, match=f"^{next(iter(bad))}: expected"):
        ops.blend_weights(**arguments | bad)


def test_points_in_transposed_memory_take_correctives():
    # Their sum kept that layout, which kernels cannot read: an AssertionError.
    made = calls(n=1)["skin correctives"].arguments
    transposed = made | {"means": made["means"].mT.contiguous().mT}
    assert not transposed["means"].is_contiguous()
    assert torch.equal(ops.skin(**transposed).means, ops.skin(**made).means)


def test_harmonics_seen_from_no_place_are_refused():
    # Their gradient by viewmats was NaN.
    scene = calls()["rasterization harmonics"].arguments
    with pytest.raises(ValueError, match="^viewmats: expected rotations, with sh_degree, got a matrix that has no inv"):
        ops.rasterization(**scene | {"viewmats": torch.full_like(scene["viewmats"], 1e-45)})


@pytest.mark.parametrize("threads", [1, 2])
def test_no_camera_at_all_draws_no_picture(dtype, threads, monkeypatch):
    monkeypatch.setattr(blend_tiles, "kernel_threads", lambda: threads)
    scene = calls(dtype=dtype)["rasterization"].arguments
    none = {name: scene[name][:0] for name in ("viewmats", "Ks", "backgrounds")}
    means = scene["means"].clone().requires_grad_()
    for options in ({}, {"render_mode": "RGB"}, {"rasterize_mode": "antialiased"}, {"absgrad": True}):
        render, alphas, _ = ops.rasterization(**scene | none | {"means": means} | options)
        assert len(render) == len(alphas) == 0
        (gradient,) = torch.autograd.grad(render.sum() + alphas.sum(), means)
        assert not gradient.any()
