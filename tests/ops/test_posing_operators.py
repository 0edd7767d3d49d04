"""What the operators of posing owe torch and their callers: graphs, odd memory, threads, bounds, other CPUs."""

import json
import os
import subprocess
import sys

import pytest
import torch

from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import DECLARATIONS, bone_transforms, face_rotations, pose_on_mesh, pose_on_mesh_covars, skin
from oasis_warp.ops._runtime import launch


def mesh(seed, n, dtype):
    """A rumpled grid of n x n cells, at rest and posed."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(n + 1.0), torch.arange(n + 1.0), indexing="ij")
    flat = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    rest = flat + 0.2 * torch.randn(flat.shape, generator=generator)
    posed = rest * torch.tensor([1.2, 0.9, 1.0]) + 0.3 * torch.randn(flat.shape, generator=generator)
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 2], 1), torch.stack([a, a + n + 2, a + n + 1], 1)])
    return rest.to(dtype), posed.to(dtype), faces


N_POSES = 9
PARENTS = (-1, 0, 1, 0, 3)


def calls(seed=0, n=4, dtype=torch.float32, empty=False, device="cpu", validate=True, few=False):
    """For each operator a function of float tensors, and these; `empty`: no points or Gaussians; `few`: few of them."""
    generator = torch.Generator().manual_seed(seed)
    rest, posed, faces = (part.to(device) for part in mesh(seed, n, dtype))
    n_vertices, n_faces = len(rest), len(faces)

    def normal(*shape):
        return torch.randn(*shape, generator=generator).to(device, dtype)

    face_index = torch.randint(n_faces, (n_faces + 3,), generator=generator).to(device)
    vertex_index = torch.randint(n_vertices, (n_vertices // 2,), generator=generator).to(device)
    if empty:
        face_index, vertex_index = face_index[:0], vertex_index[:0]
    q, p, k, n_poses = len(face_index), len(vertex_index), 0 if empty else 3 if few else 37, 2 if few else N_POSES
    unit = torch.nn.functional.normalize(normal(n_vertices, 4), dim=1)
    barycentrics = normal(q, 3).softmax(-1)

    def on_both(posed, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio):
        return pose_on_mesh(
            posed, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales,
            vertex_index=vertex_index, offsets=offsets, vertex_area_ratio=vertex_area_ratio, validate=validate,
        )  # fmt: skip

    def on_faces(posed, barycentrics, vertex_quats, area_ratio, quats, scales):
        return pose_on_mesh(posed, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, "area")

    on_mesh = [posed, barycentrics, unit, normal(n_faces).exp()]
    axes = torch.nn.functional.normalize(normal(5, 3, 3), dim=-1)

    def bent(angles, orientation, translation, joints):
        return bone_transforms(angles, orientation, translation, joints, axes, PARENTS, validate=validate)

    def corrected(means, weights, transforms, displacements, strengths):
        correctives = {"displacements": displacements, "strengths": strengths, "validate": validate}
        return skin(means, None, weights, transforms, **correctives)[:1]

    def corrected_with_covars(means, covars, weights, transforms, displacements, strengths):
        correctives = {"displacements": displacements, "strengths": strengths, "validate": validate}
        return skin(means, covars, weights, transforms, **correctives)

    many_posed = posed + 0.1 * normal(n_poses, n_vertices, 3)
    many_units = torch.nn.functional.normalize(unit + 0.1 * normal(n_poses, n_vertices, 4), dim=-1)
    many_ratios = normal(n_poses, n_faces).exp(), normal(n_poses, n_vertices).exp()
    skinned = [normal(k, 3), normal(k, 3, 3), normal(k, 5).softmax(-1)]
    return {
        "bone_transforms": (bent, [normal(4, 3), to_matrix(normal(4)), normal(3), normal(5, 3)]),
        "bone_transforms poses": (
            bent, [normal(n_poses, 4, 3), to_matrix(normal(n_poses, 4)), normal(n_poses, 3), normal(5, 3)],
        ),
        "face_rotations poses": (
            lambda rest, posed: face_rotations(rest, posed, faces, validate=validate), [rest, many_posed],
        ),
        "pose_on_mesh poses": (
            on_both,
            [many_posed, barycentrics, many_units, many_ratios[0], normal(p + q, 4), normal(p + q, 3).exp(),
             normal(p, 3), many_ratios[1]],
        ),
        "skin correctives": (
            corrected, [skinned[0], skinned[2], normal(5, 3, 4), normal(k, 3, 6), normal(6)],
        ),
        "skin poses": (
            corrected_with_covars, [*skinned, normal(n_poses, 5, 4, 4), normal(k, 3, 7), normal(n_poses, 7)],
        ),
        "face_rotations": (lambda rest, posed: face_rotations(rest, posed, faces, validate=validate), [rest, posed]),
        "pose_on_mesh": (
            on_both,
            [*on_mesh, normal(p + q, 4), normal(p + q, 3).exp(), normal(p, 3), normal(n_vertices).exp()],
        ),
        "pose_on_mesh faces": (on_faces, [*on_mesh, normal(q, 4), normal(q, 3).exp()]),
        "pose_on_mesh_covars": (
            lambda r, p, *others: pose_on_mesh_covars(r, p, faces, face_index, *others, validate=validate),
            [rest, posed, barycentrics, normal(q, 4), normal(q, 3).exp()],
        ),
        "skin": (skin, [normal(k, 3), normal(k, 3, 3), normal(k, 5).softmax(-1), normal(5, 3, 4)]),
        "skin rotation_only": (
            lambda *inputs: skin(*inputs, rotation_only=True),
            [normal(k, 3), normal(k, 3, 3), normal(k, 5).softmax(-1), normal(5, 4, 4)],
        ),
        "skin points": (
            lambda means, *others: skin(means, None, *others)[:1],
            [normal(k, 3), normal(k, 5).softmax(-1), normal(5, 3, 4)],
        ),
    }


NAMES = tuple(calls())


def results(name, function=None, **which):
    """Outputs, and gradients of a random weighting of them."""
    plain, inputs = calls(**which)[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    out = (function or plain)(*leaves)
    return [tensor.detach() for tensor in out] + weighted_gradients(out, leaves)


def weighted_gradients(out, leaves):
    generator = torch.Generator().manual_seed(5)
    loss = sum((o * torch.randn(o.shape, generator=generator).to(o)).sum() for o in out)
    return list(torch.autograd.grad(loss, leaves))


GRAPHS = (
    "bone_transforms", "face_rotations poses", "pose_on_mesh", "pose_on_mesh poses", "pose_on_mesh_covars",
    "skin rotation_only", "skin poses",
)  # fmt: skip


@pytest.mark.parametrize("name", GRAPHS)
def test_an_operator_compiles_into_one_graph_with_its_gradient(name, as_shipped):
    function, _ = calls()[name]
    torch._dynamo.reset()
    compiled = torch.compile(lambda *inputs: tuple(function(*inputs)), fullgraph=True, backend="aot_eager")
    assert all(torch.equal(a, b) for a, b in zip(results(name), results(name, compiled), strict=True))


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("backward", [False, True])
def test_what_torch_is_told_of_an_operator_is_true(name, backward):
    # Each custom op is called once by the public function: take its arguments from there.
    function, inputs = calls()[name]
    seen = []
    op = getattr(torch.ops.oasis_warp, name.split()[0] + ("_backward" if backward else "")).default

    class Spy(torch.utils._python_dispatch.TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            if func is op:
                seen.append(args)
            return func(*args, **(kwargs or {}))

    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    with Spy():
        weighted_gradients(function(*leaves), leaves)
    ((*arguments,),) = seen
    arguments = [
        a.detach().requires_grad_(not backward and a.is_floating_point()) if isinstance(a, torch.Tensor) else a
        for a in arguments
    ]
    torch.library.opcheck(op, tuple(arguments))


@pytest.mark.parametrize("name", NAMES)
def test_memory_of_any_layout_gives_the_same_bits(name, device):
    def spread(tensor):
        wide = tensor.new_full((*tensor.shape[:-1], 2 * tensor.shape[-1] + 1), torch.nan)
        wide[..., 1::2] = tensor
        return wide[..., 1::2]

    function, inputs = calls(device=device)[name]
    leaves = [spread(tensor.detach()).requires_grad_() for tensor in inputs]
    assert not any(leaf.is_contiguous() for leaf in leaves if leaf.ndim > 1)
    out = function(*leaves)
    # Gradients come in transposed memory too.
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(o.shape, generator=generator).to(o) for o in out]
    weights = [w.mT.contiguous().mT if w.ndim > 1 else w for w in weights]
    grads = torch.autograd.grad(list(out), leaves, weights)
    for a, b in zip([*out, *grads], results(name, device=device), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", NAMES)
def test_memory_that_begins_anywhere_gives_the_same_results(name, device):
    function, inputs = calls(device=device)[name]
    # Torch multiplies correctives by strengths on the CPU, and rounds as its vectors happen to lie.
    tolerance = {"rtol": 1e-5, "atol": 1e-6} if name in ("skin correctives", "skin poses") else {"rtol": 0, "atol": 0}
    for shift in (1, 2, 3):
        yards = [tensor.new_full((tensor.numel() + shift,), torch.nan) for tensor in inputs]
        leaves = [
            yard[shift:].view_as(tensor).copy_(tensor).detach().requires_grad_()
            for yard, tensor in zip(yards, inputs, strict=True)
        ]
        out = function(*leaves)
        for a, b in zip([*out, *weighted_gradients(out, leaves)], results(name, device=device), strict=True):
            torch.testing.assert_close(a, b, **tolerance)


@pytest.mark.parametrize("name", NAMES)
def test_broadcast_inputs_and_gradients_are_read_as_what_they_stand_for(name, device):
    function, inputs = calls(device=device)[name]
    repeated = [tensor[:1].expand_as(tensor) for tensor in inputs]
    full = [tensor.contiguous() for tensor in repeated]
    for leaves in (repeated, full):
        for leaf in leaves:
            leaf.requires_grad_()
    broadcast, plain = ([*function(*leaves)] for leaves in (repeated, full))
    for a, b in zip(broadcast, plain, strict=True):
        assert torch.equal(a, b)
    # The gradient of a sum is one number, expanded.
    shares = [
        torch.autograd.grad(sum(o.sum() for o in out), leaves)
        for out, leaves in ((broadcast, repeated), (plain, full))
    ]
    assert all(torch.equal(a, b) for a, b in zip(*shares, strict=True))


@pytest.mark.parametrize("n", [1, 3, 17])
@pytest.mark.parametrize("name", NAMES)
def test_float32_agrees_with_the_generic_kernels_in_float64(name, n, device):
    function, inputs = calls(1, n, device=device)[name]
    exact, wide = calls(1, n, torch.float64)[name]
    for a, b in zip(inputs, wide, strict=True):
        b.copy_(a)
    leaves, wide = ([t.clone().requires_grad_() for t in tensors] for tensors in (inputs, wide))
    out, want = function(*leaves), exact(*wide)
    for a, b in zip(out, want, strict=True):
        # A quaternion and its opposite are one rotation; signs may differ where two faces are equally large.
        assert (a.double().cpu() - b).norm() <= 5e-6 * b.norm()
    for a, b in zip(weighted_gradients(out, leaves), weighted_gradients(want, wide), strict=True):
        assert (a.double().cpu() - b).norm() <= 5e-5 * b.norm()


@pytest.mark.parametrize("name", NAMES)
def test_any_number_of_threads_gives_the_same_bits(name, with_threads):
    one, two, seven = (with_threads(k, results, name, None) for k in (1, 2, 7))
    assert all(torch.equal(a, b) and torch.equal(a, c) for a, b, c in zip(one, two, seven, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_no_gradient_is_worked_out_that_nobody_wants(name, device):
    function, inputs = calls(device=device)[name]
    with torch.no_grad():
        plain = function(*[tensor.clone().requires_grad_() for tensor in inputs])
    assert not any(out.requires_grad for out in plain)
    whole = results(name, device=device)[len(plain) :]
    for k, tensor in enumerate(inputs):
        leaves = [t.clone().requires_grad_(j == k) for j, t in enumerate(inputs)]
        (grad,) = weighted_gradients(function(*leaves), [leaves[k]])
        assert torch.equal(grad, whole[k]) and grad.shape == tensor.shape


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.usefixtures("as_shipped")
def test_gradcheck_passes_for_every_input(name):
    function, inputs = calls(n=1, dtype=torch.float64, few=True)[name]
    assert torch.autograd.gradcheck(lambda *leaves: tuple(function(*leaves)), [t.requires_grad_() for t in inputs])


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith(("face_rotations", "bone_transforms"))])
def test_without_points_or_gaussians_results_are_empty_and_gradients_zero(name):
    function, inputs = calls(empty=True)[name]
    leaves = [tensor.requires_grad_() for tensor in inputs]
    out = function(*leaves)
    assert not any(part.numel() for part in out)
    for grad, leaf in zip(weighted_gradients(out, leaves), leaves, strict=True):
        assert grad.shape == leaf.shape and not grad.any()


WITH_ALL_INPUTS = "bone_transforms", "face_rotations", "pose_on_mesh", "pose_on_mesh_covars", "skin poses"


@pytest.mark.parametrize("value", [torch.nan, -torch.inf, 1e30])
@pytest.mark.parametrize("name", WITH_ALL_INPUTS)
def test_a_value_that_is_not_finite_is_refused_by_the_name_of_its_input(name, value):
    function, inputs = calls()[name]
    for k, argument in enumerate(DECLARATIONS[name.split()[0]].differentiable):
        tensors = [tensor.clone() for tensor in inputs]
        tensors[k].view(-1)[2] = value
        with pytest.raises(ValueError, match=rf"^{argument}: expected finite values .* got 1 of "):
            function(*tensors)
        calls(validate=False)[name][0](*tensors)


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", NAMES)
def test_nothing_comes_out_that_nobody_wrote(name, dtype, empty, device):
    plain = results(name, dtype=dtype, empty=empty, device=device)
    torch.use_deterministic_algorithms(True)  # new memory is full of NaN
    try:
        assert torch.empty(1).isnan()
        filled = results(name, dtype=dtype, empty=empty, device=device)
    finally:
        torch.use_deterministic_algorithms(False)
    for a, b in zip(plain, filled, strict=True):
        assert b.isfinite().all() and torch.equal(a, b)


GUARD = 64


def test_kernels_stay_inside_their_memory(monkeypatch):
    """Every tensor that a vectorised kernel gets moves between guards, whose values must not matter nor change."""
    checked = 0

    def guarded_run(native, params, n_tasks):
        nonlocal checked
        moved, params = [], dict(params)
        for name in native.parameters:
            tensor = params.get(name)
            if isinstance(tensor, torch.Tensor) and tensor.numel():
                poison = torch.nan if tensor.is_floating_point() else torch.iinfo(tensor.dtype).max
                yard = torch.full((tensor.numel() + 2 * GUARD,), poison, dtype=tensor.dtype)
                params[name] = yard[GUARD:-GUARD].view(tensor.shape)
                params[name].copy_(tensor)
                moved.append((yard, tensor, params[name], poison))
        launch.run_native(native, params, n_tasks)
        for yard, tensor, inside, poison in moved:
            guards = torch.cat([yard[:GUARD], yard[-GUARD:]])
            assert guards.isnan().all() if yard.is_floating_point() else (guards == poison).all()
            tensor.copy_(inside)
            checked += 1

    cases = [(name, {"n": n, "empty": empty}) for name in NAMES for n in (1, 2, 5) for empty in (False, True)]
    plain = [results(name, **which) for name, which in cases]
    for module in ("_runtime.mesh_gaussians", "bone_transforms", "face_rotations", "skinning"):
        monkeypatch.setattr(sys.modules[f"oasis_warp.ops.{module}"], "run_native", guarded_run)
    for (name, which), want in zip(cases, plain, strict=True):
        for a, b in zip(results(name, **which), want, strict=True):
            assert torch.equal(a, b), (name, which)
    assert checked > 300


DIGEST = """
import json, sys, torch
sys.path.insert(0, sys.argv[1])
import test_posing_operators as t
out = {name: [r.flatten().double().tolist() for r in t.results(name, n=5)] for name in t.NAMES}
print(json.dumps(out))
"""


@pytest.mark.slow
@pytest.mark.parametrize("flags", ["-target-cpu x86-64-v3", "-target-cpu x86-64-v2"])
def test_narrower_vectors_give_the_same_results(flags, tmp_path):
    here = os.path.dirname(__file__)
    environment = os.environ | {"OASIS_WARP_CPU_FLAGS": flags, "OASIS_WARP_CACHE": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", DIGEST, here], env=environment, capture_output=True, text=True, check=True
    )
    other = json.loads(run.stdout.splitlines()[-1])
    for name in NAMES:
        for a, b in zip(results(name, n=5), other[name], strict=True):
            b = torch.tensor(b, dtype=torch.float64)
            assert (a.flatten().double() - b).norm() <= 3e-6 * b.norm(), name
