"""No argument of an operator crashes it, hangs it, or turns into NaN without a word."""

import hostile_arguments
import numpy as np
import pytest
import torch
from operator_calls import calls, mesh

from oasis_warp import ops
from oasis_warp.ops import DECLARATIONS
from oasis_warp.ops._runtime import tiles

pytestmark = pytest.mark.usefixtures("as_shipped")
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
    monkeypatch.setattr(tiles, "kernel_threads", lambda: threads)
    scene = calls(dtype=dtype)["rasterization"].arguments
    none = {name: scene[name][:0] for name in ("viewmats", "Ks", "backgrounds")}
    means = scene["means"].clone().requires_grad_()
    for options in ({}, {"render_mode": "RGB"}, {"rasterize_mode": "antialiased"}, {"absgrad": True}):
        render, alphas, _ = ops.rasterization(**scene | none | {"means": means} | options)
        assert len(render) == len(alphas) == 0
        (gradient,) = torch.autograd.grad(render.sum() + alphas.sum(), means)
        assert not gradient.any()
