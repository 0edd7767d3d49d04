"""What every operator owes its callers: gradients, odd memory, threads, bounds, refusals, other CPUs, many poses."""

import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from operator_calls import (
    N_POSES,
    NAMES,
    ONE_OF_EACH,
    assert_same_bits,
    call_of,
    calls,
    gradients,
    results,
    weights_of,
)

from oasis_warp.ops import DECLARATIONS
from oasis_warp.ops._runtime import launch

EVERY_CALL = pytest.mark.parametrize("name", NAMES)
SHARED = {
    "bone_transforms poses": {"joints"},
    "face_rotations poses": {"rest_vertices"},
    "pose_on_mesh poses": {"barycentrics", "quats", "scales", "offsets"},
    "skin poses": {"means", "covars", "weights", "displacements"},
    "depth_visibility poses": {"points"},
}
"""Calls for several poses, and the inputs that all poses share."""


def tolerance(name):
    """Torch computes a sum in these, and rounds as its threads and vectors happen to share it out; else exact.

    Sums of some thirty numbers of size 1: the bits of their rounding differ from processor to processor.
    """
    summed = name in ("skin correctives", "skin poses", "depth_visibility poses")
    return {"rtol": 1e-5, "atol": 4e-6} if summed else {"rtol": 0, "atol": 0}


def spread(tensor):
    """The same numbers, with NaN between them in memory."""
    wide = tensor.new_full((*tensor.shape[:-1], 2 * tensor.shape[-1] + 1), torch.nan)
    wide[..., 1::2] = tensor
    return wide[..., 1::2]


@EVERY_CALL
def test_memory_of_any_layout_gives_the_same_results(name, device):
    call = calls(device=device)[name]
    leaves = [spread(tensor).requires_grad_() for tensor in call.inputs]
    assert not any(leaf.is_contiguous() for leaf in leaves if leaf.ndim > 1)
    out = call.function(*leaves)
    # Gradients come in transposed memory too.
    weighted = [(o, w.mT.contiguous().mT if w.ndim > 1 else w) for o, w in zip(out, weights_of(out), strict=True)]
    given, weights = zip(*(pair for pair in weighted if pair[0].requires_grad), strict=True)
    found = [*out, *torch.autograd.grad(given, leaves, weights)]
    torch.testing.assert_close(found, results(name, device=device), **tolerance(name))


@EVERY_CALL
@pytest.mark.parametrize("shift", [1, 2, 3])
def test_memory_that_begins_anywhere_gives_the_same_results(name, shift, device):
    def moved(tensor):
        return torch.cat([tensor.new_full((shift,), torch.nan), tensor.flatten()])[shift:].view_as(tensor)

    found = results(name, None, moved, device=device)
    torch.testing.assert_close(found, results(name, device=device), **tolerance(name))


@EVERY_CALL
def test_broadcast_inputs_and_gradients_are_read_as_what_they_stand_for(name, device):
    call = calls(device=device)[name]
    repeated = [tensor[:1].expand_as(tensor) for tensor in call.inputs]
    found = []
    for leaves in (repeated, [tensor.contiguous() for tensor in repeated]):
        out = call.function(*(leaf.requires_grad_() for leaf in leaves))
        # The gradient of a sum is one number, expanded.
        found.append([*out, *torch.autograd.grad(sum(o.sum() for o in out if o.requires_grad), leaves)])
    assert_same_bits(*found)


@pytest.mark.parametrize("n", [1, 3, 17])
@EVERY_CALL
def test_float32_agrees_with_the_generic_kernels_in_float64(name, n, device):
    call, exact = calls(1, n, device=device)[name], calls(1, n, torch.float64)[name]
    for a, b in zip(call.inputs, exact.inputs, strict=True):
        b.copy_(a)
    leaves, wide = call.leaves(), exact.leaves()
    out, want = call.function(*leaves), exact.function(*wide)
    for a, b in zip(out, want, strict=True):
        # A quaternion and its opposite are one rotation; signs may differ where two faces are equally large.
        assert (a.double().cpu() - b).norm() <= 5e-6 * b.norm()
    error = 1e-4 if name == "rasterization" else 5e-5  # expected depths divide by alpha, which may be small
    for a, b in zip(gradients(out, leaves), gradients(want, wide), strict=True):
        assert (a.double().cpu() - b).norm() <= error * b.norm()


@pytest.mark.parametrize(
    "which", [{"n": 4}, {"n": 65, "dtype": torch.float64, "n_poses": 1}], ids=["float32", "float64"]
)  # generic kernels are shared out from 4096 rows on
@EVERY_CALL
def test_any_number_of_threads_gives_the_same_results(name, which, with_threads):
    one = with_threads(1, lambda: results(name, **which))
    for n_threads in (2, 7):
        torch.testing.assert_close(with_threads(n_threads, lambda: results(name, **which)), one, **tolerance(name))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # from Python 3.12 on
def test_eight_threads_of_the_caller_and_a_forked_process_give_the_same_bits():
    made = calls()

    def all_results():
        with torch.no_grad():
            return [out for name in ONE_OF_EACH for out in made[name].function(*made[name].inputs)]

    alone = all_results()
    with ThreadPoolExecutor(8) as pool:
        for beside in pool.map(lambda _: all_results(), range(8)):
            assert_same_bits(beside, alone)
    child = os.fork()
    if not child:
        same = False
        try:
            same = all(map(torch.equal, all_results(), alone))
        finally:
            os._exit(0 if same else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@EVERY_CALL
def test_no_gradient_is_worked_out_that_nobody_wants(name, device):
    call = calls(device=device)[name]
    with torch.no_grad():
        plain = call.function(*call.leaves())
    assert not any(out.requires_grad for out in plain)
    whole = results(name, device=device)
    assert_same_bits(plain, whole[: len(plain)])
    whole = whole[len(plain) :]
    for k, tensor in enumerate(call.inputs):
        leaves = [t.clone().requires_grad_(j == k) for j, t in enumerate(call.inputs)]
        (grad,) = gradients(call.function(*leaves), [leaves[k]])
        assert torch.equal(grad, whole[k]) and grad.shape == tensor.shape


@EVERY_CALL
def test_gradients_of_single_results_add_up(name, device):
    call = calls(dtype=torch.float64, device=device)[name]
    leaves = call.leaves()
    out = call.function(*leaves)
    parts = [(o * w).sum() for o, w in zip(out, weights_of(out), strict=True) if o.requires_grad]
    options = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    shares = [torch.autograd.grad(part, leaves, **options) for part in parts]
    for whole, *terms in zip(torch.autograd.grad(sum(parts), leaves), *shares, strict=True):
        assert (sum(terms) - whole).norm() <= 1e-12 * whole.norm()


@EVERY_CALL
@pytest.mark.usefixtures("as_shipped")
def test_gradients_are_those_of_finite_differences(name, device):
    call = calls(n=1, dtype=torch.float64, n_poses=2, device=device)[name]
    assert torch.autograd.gradcheck(call.function, call.leaves(), nondet_tol=0.0, fast_mode=True)


@pytest.mark.parametrize(
    "name", [name for name in NAMES if name.startswith(("pose_on_mesh", "skin", "spherical_harmonics"))]
)
def test_without_points_or_gaussians_results_are_empty_and_gradients_zero(name, device):
    call = calls(empty=True, device=device)[name]
    leaves = call.leaves()
    out = call.function(*leaves)
    assert not any(part.numel() for part in out)
    for grad, leaf in zip(gradients(out, leaves), leaves, strict=True):
        assert grad.shape == leaf.shape and not grad.any()


@pytest.mark.parametrize("value", [torch.nan, -torch.inf, 1e30])
@pytest.mark.parametrize("name", ONE_OF_EACH[:-1])  # harmonics are checked as the colours that they give
def test_a_value_that_is_not_finite_is_refused_by_the_name_of_its_input(name, value):
    call, trusting = calls()[name], calls(validate=False)[name]
    for key, tensor in zip(call.names, call.inputs, strict=True):
        spoiled = tensor.clone()
        spoiled.view(-1)[2] = value
        inputs = [spoiled if t is tensor else t for t in call.inputs]
        with pytest.raises(ValueError, match=rf"^{key}: expected finite values below 1e\+15, got [12] of "):
            call.function(*inputs)
        trusting.function(*inputs)


@pytest.mark.parametrize("empty", [False, True])
@EVERY_CALL
def test_nothing_comes_out_that_nobody_wrote(name, dtype, empty, device):
    plain = results(name, dtype=dtype, empty=empty, device=device)
    torch.use_deterministic_algorithms(True)  # new memory is full of NaN
    try:
        assert torch.empty(1).isnan()
        filled = results(name, dtype=dtype, empty=empty, device=device)
    finally:
        torch.use_deterministic_algorithms(False)
    assert_same_bits(plain, filled)
    assert all(part.isfinite().all() for part in filled)


# Refusals


def examples():
    """Keyword arguments of every public operator."""
    made = {name.split()[0]: call.arguments for name, call in calls().items() if name in (*NAMES_OF_PUBLIC,)}
    scene = made["rasterization"]
    camera = {"viewmat": scene["viewmats"][0], "K": scene["Ks"][0]}
    size = {"width": 17, "height": 15}
    gaussians = {name: scene[name] for name in ("means", "quats", "scales", "opacities")}
    weights = DECLARATIONS["blend_weights"].function(**gaussians, **camera, **size)
    mesh_ahead = {name: made["depth_visibility"][name] for name in ("vertices", "faces")}
    bent = made["face_rotations"]
    return made | {
        "blend_weights": gaussians | camera | size,
        "blend_colors": {"weights": weights, "colors": scene["colors"]},
        "depth_map": mesh_ahead | camera | size,
        "rest_mesh": {name: bent[name] for name in ("rest_vertices", "faces")},
    }


NAMES_OF_PUBLIC = (
    "bone_transforms", "face_rotations", "pose_on_mesh", "pose_on_mesh_covars", "skin poses", "depth_visibility",
    "rasterization",
)  # fmt: skip


@pytest.mark.parametrize("name", [name for name in DECLARATIONS if name != "spherical_harmonics"])  # which broadcasts
@pytest.mark.usefixtures("as_shipped")
def test_a_tensor_of_another_shape_type_or_device_is_refused_by_name(name):
    declaration, arguments = DECLARATIONS[name], examples()[name]
    floats = [key for key, declared in declaration.inputs.items() if not declared.index and key in arguments]
    for key, declared in declaration.inputs.items():
        tensor = arguments.get(key)
        if tensor is None:
            continue

        def refuses(message, bad, key=key):
            with pytest.raises(ValueError, match=message):
                declaration.function(**arguments | {key: bad})

        refuses(rf"^{key}: expected shape \[.*\], got \[.*\].*{re.escape(declared.hint)}$", tensor[..., None])
        letters = [d for other, array in declaration.inputs.items() if other != key for d in array.dims]
        if declared.dims[0] in letters:  # of unlike lengths either may be named
            refuses(r"^\w+: expected (shape|indices)", tensor[:-1])
        if declared.index:
            refuses(f"^{key}: expected int32 or int64, got float32", tensor.float())
            for index in (declared.least - 1, 1000):
                refuses(f"^{key}: expected indices in {declared.least} .. ", torch.full_like(tensor, index))
        elif key == floats[0]:
            refuses(f"^{key}: expected float32 or float64, got float16", tensor.half())
        else:
            expected = f"^{key}: expected torch.float32 on cpu"
            refuses(f"{expected}, got torch.float64 on cpu", tensor.double())
            refuses(f"{expected}, got torch.float32 on meta", tensor.to("meta"))


@pytest.mark.parametrize("name", [name for name, declared in DECLARATIONS.items() if "faces" in declared.inputs])
def test_without_validation_values_go_through_and_indices_do_not(name):
    function, arguments = DECLARATIONS[name].function, examples()[name]
    assert_same_bits(function(**arguments | {"validate": True}), function(**arguments | {"validate": False}))
    with pytest.raises(ValueError, match="^faces: expected indices in 0 .. 24"):
        function(**arguments | {"validate": False, "faces": arguments["faces"] + 1})


# Memory

GUARD = 64


def test_vectorised_kernels_stay_inside_their_memory(monkeypatch):
    """Every tensor that such a kernel gets moves between guards, whose values must not matter nor change."""
    checked = 0

    def guarded_run(native, params, n_tasks):
        nonlocal checked
        moved, params = [], dict(params)
        for name in native.parameters:
            tensor = params.get(name)
            if isinstance(tensor, torch.Tensor) and tensor.numel():
                poison = torch.nan if tensor.is_floating_point() else torch.iinfo(tensor.dtype).max
                memory = torch.full((tensor.numel() + 2 * GUARD,), poison, dtype=tensor.dtype)
                params[name] = memory[GUARD:-GUARD].view(tensor.shape)
                params[name].copy_(tensor)
                moved.append((memory, tensor, params[name], poison))
        run_native(native, params, n_tasks)
        for memory, tensor, inside, poison in moved:
            guards = torch.cat([memory[:GUARD], memory[-GUARD:]])
            assert guards.isnan().all() if memory.is_floating_point() else (guards == poison).all()
            tensor.copy_(inside)
            checked += 1

    run_native = launch.run_native
    names = [name for name in NAMES if name.startswith(("bone_transforms", "face_rotations", "pose_on_mesh", "skin"))]
    cases = [(name, {"n": n, "empty": empty}) for name in names for n in (1, 2, 5) for empty in (False, True)]
    plain = [results(name, **which) for name, which in cases]
    for module in (launch, sys.modules["oasis_warp.ops.bone_transforms"]):
        monkeypatch.setattr(module, "run_native", guarded_run)
    for (name, which), want in zip(cases, plain, strict=True):
        assert_same_bits(results(name, **which), want, (name, which))
    assert checked > 300


# Other CPUs

DIGEST = """
import json, sys
sys.path.insert(0, sys.argv[1])
from operator_calls import NAMES, results
print(json.dumps({name: [r.flatten().double().tolist() for r in results(name, n=5)] for name in NAMES}))
"""


@pytest.mark.slow
@pytest.mark.parametrize("flags", ["-target-cpu x86-64-v3", "-target-cpu x86-64-v2"])
def test_narrower_vectors_give_the_same_results(flags):
    environment = os.environ | {"OASIS_WARP_CPU_FLAGS": flags}  # part of what vectorised kernels are cached by
    command = [sys.executable, "-c", DIGEST, os.path.dirname(__file__)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    other = json.loads(run.stdout.splitlines()[-1])
    for name in NAMES:
        for a, b in zip(results(name, n=5), other[name], strict=True):
            b = torch.tensor(b, dtype=torch.float64)
            assert (a.flatten().double() - b).norm() <= 1e-5 * b.norm(), name


# Poses


@pytest.mark.parametrize("name", SHARED)
def test_many_poses_in_one_call_are_what_as_many_calls_give(name, dtype, device):
    call = calls(dtype=dtype, device=device)[name]
    leaves = call.leaves()
    named = list(zip(call.names, leaves, strict=True))
    together = call.function(*leaves)
    alone = [
        call_of(call.operator, call.arguments, ()).function(*(t if key in SHARED[name] else t[k] for key, t in named))
        for k in range(N_POSES)
    ]
    stacked = [torch.stack(parts) for parts in zip(*alone, strict=True)]
    assert_same_bits(together, stacked)
    for a, b in zip(gradients(together, leaves), gradients(stacked, leaves), strict=True):
        # The poses' shares of a gradient add up in another order.
        assert (a - b).norm() <= (2e-6 if dtype == torch.float32 else 1e-14) * b.norm()


@pytest.mark.parametrize("name", SHARED)
def test_no_poses_give_empty_results_and_zero_gradients(name, dtype, device):
    call = calls(dtype=dtype, device=device)[name]
    inputs = [t if key in SHARED[name] else t[:0] for key, t in zip(call.names, call.inputs, strict=True)]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    out = call.function(*leaves)
    assert all(len(part) == 0 for part in out)
    for grad, leaf in zip(gradients(out, leaves), leaves, strict=True):
        assert grad.shape == leaf.shape and not grad.any()


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:The AccumulateGrad node's stream does not match")
@pytest.mark.parametrize("name", [*SHARED, "skin correctives"])
def test_a_graph_that_was_captured_once_follows_new_inputs_forwards_and_backwards(name):
    call = calls(device="cuda", validate=False)[name]
    leaves, others = call.leaves(), calls(seed=3, device="cuda")[name].inputs
    with torch.no_grad():
        weights = weights_of(call.function(*leaves))

    def step():
        out = call.function(*leaves)
        given, incoming = zip(*(pair for pair in zip(out, weights, strict=True) if pair[0].requires_grad), strict=True)
        return [*out, *torch.autograd.grad(given, leaves, incoming)]

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        step()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    with torch.no_grad():
        for leaf, other in zip(leaves, others, strict=True):
            leaf.copy_(other)
    graph.replay()
    found = [tensor.clone() for tensor in captured]
    assert_same_bits(found, step())
