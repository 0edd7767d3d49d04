"""An operator is what torch expects of a custom op: one node of a graph, whose plain calls bypass the dispatcher."""

import contextlib
import gc
import importlib
import inspect
import warnings
import weakref

import pytest
import torch
from operator_calls import ONE_OF_EACH, assert_same_bits, calls, gradients, loss_of, mesh, results, weights_of
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode

from oasis_warp import ops
from oasis_warp.ops import DECLARATIONS, face_rotations, rest_mesh

OTHERS_IN_FLOAT64 = "face_rotations poses", "pose_on_mesh poses", "depth_visibility", "rasterization"
"""Calls that save other tensors for the adjoint in float64."""
EACH = pytest.mark.parametrize("name", ONE_OF_EACH)


class Watched(TorchDispatchMode):
    """Does nothing but being there, and keeps the calls of our ops that pass: names and arguments."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.namespace == "oasis_warp":
            self.seen.append((func._schema.name.removeprefix("oasis_warp::"), args))
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", DECLARATIONS)
def test_a_declaration_describes_its_public_function_and_names_its_reference(name):
    declared = DECLARATIONS[name]
    parameters = inspect.signature(declared.function).parameters
    assert declared.inputs.keys() <= parameters.keys()
    if declared.reference:
        module, function = declared.reference.split(".")
        assert callable(getattr(importlib.import_module(f"oasis_warp.reference.{module}"), function))


@EACH
def test_an_operator_compiles_into_one_graph_with_its_gradient(name, as_shipped):
    torch._dynamo.reset()
    compiled = torch.compile(calls()[name].function, fullgraph=True, backend="aot_eager")
    assert_same_bits(results(name, compiled), results(name))


def test_functions_without_a_gradient_compile_into_one_graph(as_shipped):
    rest, posed, faces = mesh(2, 3, torch.float32)
    seen = {name: calls()["depth_visibility"].arguments[name] for name in ("vertices", "faces", "viewmat", "K")}

    def rotated(posed, vertices):
        covered = ops.depth_map(**seen | {"vertices": vertices}, width=16, height=16).face_ids >= 0
        return *face_rotations(rest_mesh(rest, faces), posed, faces), covered

    torch._dynamo.reset()
    compiled = torch.compile(rotated, fullgraph=True, backend="aot_eager")
    assert_same_bits(compiled(posed, seen["vertices"]), rotated(posed, seen["vertices"]))


@pytest.mark.parametrize(
    ("name", "dtype"),
    [*((name, torch.float32) for name in ONE_OF_EACH), *((name, torch.float64) for name in OTHERS_IN_FLOAT64)],
)
def test_what_torch_is_told_of_an_operator_is_true(name, dtype):
    call = calls(n=2, dtype=dtype, n_poses=2)[name]
    leaves = call.leaves()
    checked = ["test_schema", "test_faketensor"]
    if dtype == torch.float32:  # traced, which takes longest, both precisions are alike
        checked += ["test_autograd_registration", "test_aot_dispatch_dynamic"]
    with Watched() as watched:
        gradients(call.function(*leaves), leaves)
    for op, arguments in watched.seen:
        if op.startswith("blend"):  # passes opaque buffers, which opcheck copies without what is behind them
            continue
        needs_gradient = not op.endswith("_backward")
        arguments = [
            a.detach().requires_grad_(needs_gradient and a.is_floating_point()) if isinstance(a, torch.Tensor) else a
            for a in arguments
        ]
        torch.library.opcheck(getattr(torch.ops.oasis_warp, op).default, tuple(arguments), test_utils=checked)


def test_what_torch_is_told_of_ops_that_need_no_gradient_is_true(dtype):
    rest, _, faces = mesh(2, 3, dtype)
    torch.library.opcheck(torch.ops.oasis_warp.rest_mesh.default, (rest, faces, True))
    seen = calls(dtype=dtype)["depth_visibility"].arguments
    drawn = seen["vertices"][None], seen["faces"], seen["viewmat"][None], seen["K"][None], 16, 16, 0.01
    for outputs in ((True, True, True), (False, True, False)):
        torch.library.opcheck(torch.ops.oasis_warp.depth_map.default, (*drawn, *outputs, True))
    looked = seen["points"][None], *drawn[:4], None, False, 16, 16, 0.01, 0.1, 0.3
    for maps in (True, False):
        torch.library.opcheck(torch.ops.oasis_warp.depth_visibility.default, (*looked, maps, False, True))


@EACH
def test_a_plain_call_has_the_bits_of_the_custom_op(name):
    with Watched() as watched:
        through_torch = results(name)
    forward = calls()[name].custom_ops
    assert [op for op, _ in watched.seen] == [*forward, *(f"{op}_backward" for op in reversed(forward))]
    assert_same_bits(results(name), through_torch)


def test_plain_calls_do_not_pass_through_the_dispatcher():
    def dispatched(mode):
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile, mode:
            for name in ONE_OF_EACH:
                results(name)
        return {event.key for event in profile.key_averages() if event.key.startswith("oasis_warp::")}

    assert len(dispatched(Watched())) >= len(ONE_OF_EACH) and not dispatched(contextlib.nullcontext())


@EACH
def test_a_tracer_sees_one_node_for_an_operator(name, as_shipped):
    call = calls()[name]
    graph = make_fx(call.function)(*call.inputs)
    nodes = [n.target.name() for n in graph.graph.nodes if str(n.target).startswith("oasis_warp")]
    assert nodes == [f"oasis_warp::{op}" for op in call.custom_ops]
    assert_same_bits(graph(*call.inputs), call.function(*call.inputs))


def test_fake_tensors_meet_no_kernel():
    call = calls()["spherical_harmonics"]
    mode = FakeTensorMode()
    fakes = [mode.from_tensor(t).requires_grad_() for t in call.inputs]
    for _ in range(2):
        (out,) = call.function(*fakes)  # outside of their mode, and then in it
        grads = torch.autograd.grad(out.sum(), fakes)
        assert [type(t) for t in (out, *grads)] == [type(fakes[0])] * 3
        assert [t.shape for t in (out, *grads)] == [(18, 3), (18, 3), (18, 16, 3)]
        mode.__enter__()
    mode.__exit__(None, None, None)
    mode.__exit__(None, None, None)


@pytest.mark.parametrize("traced", [False, True])
@EACH
def test_a_second_derivative_is_refused(name, traced):
    call = calls()[name]
    leaves = call.leaves()

    def first():
        return torch.autograd.grad(loss_of(call.function(*leaves)), leaves, create_graph=True)

    if traced:
        with Watched():
            grads = first()
    else:
        grads = first()
    assert_same_bits([g.detach() for g in grads], results(name)[-len(leaves) :])
    with pytest.raises(RuntimeError, match=f"^{call.operator}: expected one derivative, got a"):
        torch.autograd.grad(sum(g.sum() for g in grads), leaves)


@EACH
def test_a_graph_that_is_kept_can_be_walked_again_and_else_not(name):
    call = calls()[name]
    leaves = call.leaves()
    loss = loss_of(call.function(*leaves))
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    assert_same_bits(torch.autograd.grad(loss, leaves), first)
    with pytest.raises(RuntimeError, match="a second time"):
        torch.autograd.grad(loss, leaves)


@EACH
def test_inputs_that_changed_under_the_graph_are_refused(name):
    call = calls()[name]
    leaves = call.leaves()
    out = call.function(*leaves)
    with torch.no_grad():
        for leaf in leaves:
            leaf.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        gradients(out, leaves)


@pytest.mark.parametrize("backward", [False, True])
@EACH
def test_nothing_lives_longer_than_its_graph(name, backward):
    call = calls()[name]
    gc.disable()  # reference counts alone have to do it: a cycle would hold the memory until the next collection
    try:
        leaves = call.leaves()
        out = call.function(*leaves)
        if backward:
            gradients(out, leaves)
        watched = [weakref.ref(tensor) for tensor in (*leaves, *out)]
        del leaves, out
        assert not any(tensor() is not None for tensor in watched)
    finally:
        gc.enable()


@EACH
def test_checkpoints_and_hooks_find_what_they_look_for(name):
    call = calls()[name]
    leaves = call.leaves()
    out = torch.utils.checkpoint.checkpoint(call.function, *leaves, use_reentrant=False)
    seen = []
    out[0].register_hook(seen.append)
    assert_same_bits([*(o.detach() for o in out), *gradients(out, leaves)], results(name))
    assert torch.equal(seen[0], weights_of(out)[0])


def opposite(tensor):
    """`tensor` as torch may hand it out: in memory the negative, with a flag that says so."""
    lazy = torch._neg_view(-tensor)
    assert lazy.is_neg() and torch.equal(lazy.detach(), tensor.detach())
    return lazy


@EACH
def test_memory_that_holds_the_opposite_is_read_as_what_it_stands_for(name):
    assert_same_bits(results(name, None, opposite), results(name))
    call = calls()[name]
    leaves = call.leaves()
    out = [o for o in call.function(*leaves) if o.requires_grad]
    incoming = weights_of(out)
    plain = torch.autograd.grad(out, leaves, incoming, retain_graph=True)
    assert_same_bits(torch.autograd.grad(out, leaves, [opposite(g) for g in incoming]), plain)


class Labelled(torch.Tensor):
    """A tensor of a user's own kind."""


@EACH
def test_other_kinds_of_tensors_and_default_devices_change_nothing(name, as_shipped):
    plain = results(name)
    assert_same_bits(results(name, None, lambda leaf: leaf.as_subclass(Labelled)), plain)
    call = calls()[name]
    parameters = [torch.nn.Parameter(tensor.clone()) for tensor in call.inputs]
    out = call.function(*parameters)
    assert_same_bits([*(o.detach() for o in out), *gradients(out, parameters)], plain)
    if not name.startswith("rasterization"):  # which makes tensors itself
        with torch.device("meta"):
            elsewhere = call.function(*call.inputs)
        assert_same_bits(elsewhere, plain[: len(elsewhere)])


def test_transforms_of_functions_go_through_torch():
    directions, coefficients = calls()["spherical_harmonics"].inputs
    one_by_one = torch.stack([ops.spherical_harmonics(2, d, coefficients[0]) for d in directions])
    with warnings.catch_warnings(action="ignore"):  # that it is slow
        mapped = torch.func.vmap(lambda d: ops.spherical_harmonics(2, d, coefficients[0]))(directions)
    assert torch.equal(mapped, one_by_one)
