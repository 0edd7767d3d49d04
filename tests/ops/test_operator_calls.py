"""A plain call of an operator, which bypasses torch's dispatcher, is the custom op in all but its time."""

import gc
import importlib
import inspect
import warnings
import weakref

import pytest
import test_posing_operators
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode

from oasis_warp import ops
from oasis_warp.ops import DECLARATIONS


def spherical_harmonics():
    g = torch.Generator().manual_seed(0)
    directions, coefficients = torch.randn(5, 3, generator=g), torch.randn(5, 16, 3, generator=g)
    return lambda d, c: ops.spherical_harmonics(3, d, c), [directions, coefficients]


def gaussians(n=6):
    g = torch.Generator().manual_seed(1)
    means = torch.randn(n, 3, generator=g) * 0.3
    quats, scales = torch.randn(n, 4, generator=g), torch.rand(n, 3, generator=g) * 0.2 + 0.05
    return means, quats, scales, torch.rand(n, generator=g) * 0.8 + 0.1


def camera():
    viewmat = torch.eye(4)
    viewmat[2, 3] = 2.0
    return viewmat, torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])


def rasterization():
    viewmat, K = camera()

    def draw(means, quats, scales, opacities, colors, backgrounds, viewmats):
        image, alphas, meta = ops.rasterization(
            means, quats, scales, opacities, colors, viewmats, K[None], 17, 15, backgrounds=backgrounds,
            render_mode="RGB+ED",
        )  # fmt: skip
        return image, alphas, meta["means2d"]

    g = torch.Generator().manual_seed(2)
    return draw, [*gaussians(), torch.rand(6, 3, generator=g), torch.rand(1, 3, generator=g), viewmat[None]]


def rasterization_of_harmonics_and_covariances():
    viewmat, K = camera()
    means, _, scales, opacities = gaussians()

    def draw(means, variances, opacities, coefficients):
        covars = torch.diag_embed(variances)
        image, alphas, _ = ops.rasterization(
            means, None, None, opacities, coefficients, viewmat[None], K[None], 17, 15, covars=covars, sh_degree=1
        )
        return image, alphas

    coefficients = torch.rand(6, 4, 3, generator=torch.Generator().manual_seed(3))
    return draw, [means, scales.square(), opacities, coefficients]


CASES = [spherical_harmonics, rasterization, rasterization_of_harmonics_and_covariances]


def visibility():
    rest, _, faces = test_posing_operators.mesh(0, 4, torch.float32)
    K, viewmat = torch.tensor([[10.0, 0, 8], [0, 10, 8], [0, 0, 1]]), torch.eye(4)

    def look(points, vertices):
        seen = ops.depth_visibility(points, vertices, faces, K, viewmat, 16, 16, 0.1)
        return seen.visibility, seen.depth_map

    ahead = rest - torch.tensor([2.0, 2.0, -6.0])
    return look, [ahead[:7] + 0.01, ahead]


def cases():
    """Of each operator and way of calling it: a function of float tensors, and these."""
    made = {case.__name__: case() for case in CASES} | {"visibility": visibility()}
    posing = test_posing_operators.calls()
    return made | {name: posing[name] for name in POSING}


POSING = "bone_transforms poses", "face_rotations poses", "pose_on_mesh poses", "pose_on_mesh_covars", "skin poses"
NAMES = tuple(cases())
OPERATORS = {
    "spherical_harmonics": ["spherical_harmonics"],
    "rasterization": ["project", "blend"],
    "rasterization_of_harmonics_and_covariances": ["sh_to_rgb", "project", "blend"],
    "visibility": ["depth_visibility"],
} | {name: [name.split()[0]] for name in POSING}
"""The custom ops that a case calls, in this order."""


class Watched(TorchDispatchMode):
    """Does nothing but being there, and keeps the names of our ops that pass."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.namespace == "oasis_warp":
            self.names.append(func._schema.name.removeprefix("oasis_warp::"))
        return func(*args, **(kwargs or {}))


def outputs(call, inputs):
    out = call(*inputs)
    return [out] if isinstance(out, torch.Tensor) else list(out)


def weighted(out):
    return sum(((k + 1) * o).square().sum() for k, o in enumerate(out) if o.requires_grad)


def results(name, transform=lambda leaf: leaf, call=None):
    plain, inputs = cases()[name]
    call = call or plain
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    out = outputs(call, [transform(leaf) for leaf in leaves])
    return [o.detach() for o in out] + list(torch.autograd.grad(weighted(out), leaves))


def assert_same_bits(some, others):
    assert len(some) == len(others)
    assert all(torch.equal(a, b) for a, b in zip(some, others, strict=True))


@pytest.mark.parametrize("name", DECLARATIONS)
def test_a_declaration_describes_its_public_function_and_names_its_reference(name):
    declared = DECLARATIONS[name]
    parameters = inspect.signature(declared.function).parameters
    assert declared.inputs.keys() <= parameters.keys()
    if declared.reference:
        module, function = declared.reference.split(".")
        assert callable(getattr(importlib.import_module(f"oasis_warp.reference.{module}"), function))


@pytest.mark.parametrize("name", [case.__name__ for case in CASES])
def test_an_operator_compiles_into_one_graph_with_its_gradient(name, as_shipped):
    call, _ = cases()[name]
    torch._dynamo.reset()
    compiled = torch.compile(call, fullgraph=True, backend="aot_eager")
    assert_same_bits(results(name, call=compiled), results(name))


@pytest.mark.parametrize("name", NAMES)
def test_a_plain_call_has_the_bits_of_the_custom_op(name):
    with Watched() as watched:
        through_torch = results(name)
    forward = OPERATORS[name]
    assert watched.names == forward + [f"{op}_backward" for op in reversed(forward)]
    assert_same_bits(results(name), through_torch)


@pytest.mark.parametrize("name", NAMES)
def test_a_plain_call_does_not_pass_through_the_dispatcher(name):
    def ours(run):
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
            run()
        return [event.key for event in profile.key_averages() if event.key.startswith("oasis_warp::")]

    def watched():
        with Watched():
            results(name)

    assert ours(watched) and not ours(lambda: results(name))


@pytest.mark.parametrize("name", NAMES)
def test_a_tracer_sees_one_node_for_an_operator(name, as_shipped):
    call, inputs = cases()[name]
    graph = make_fx(lambda *inputs: outputs(call, inputs))(*inputs)
    nodes = [n.target.name() for n in graph.graph.nodes if str(n.target).startswith("oasis_warp")]
    assert nodes == [f"oasis_warp::{op}" for op in OPERATORS[name]]
    assert_same_bits(graph(*inputs), outputs(call, inputs))


def test_fake_tensors_meet_no_kernel():
    directions, coefficients = spherical_harmonics()[1]
    mode = FakeTensorMode()
    fakes = [mode.from_tensor(t).requires_grad_() for t in (directions, coefficients)]
    for _ in range(2):
        out = ops.spherical_harmonics(3, *fakes)  # outside of their mode, and then in it
        grads = torch.autograd.grad(out.sum(), fakes)
        assert [type(t) for t in (out, *grads)] == [type(fakes[0])] * 3
        assert [t.shape for t in (out, *grads)] == [(5, 3), (5, 3), (5, 16, 3)]
        mode.__enter__()
    mode.__exit__(None, None, None)
    mode.__exit__(None, None, None)


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_a_second_derivative_is_refused_in_words(name, traced):
    call, inputs = cases()[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]

    def first():
        return torch.autograd.grad(weighted(outputs(call, leaves)), leaves, create_graph=True)

    if traced:
        with Watched():
            grads = first()
    else:
        grads = first()
    assert_same_bits([g.detach() for g in grads], results(name)[-len(leaves) :])
    with pytest.raises(RuntimeError, match=f"({'|'.join(OPERATORS[name])}): expected one derivative, got a"):
        torch.autograd.grad(sum(g.sum() for g in grads), leaves)


@pytest.mark.parametrize("name", NAMES)
def test_a_graph_that_is_kept_can_be_walked_again_and_else_not(name):
    call, inputs = cases()[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    loss = weighted(outputs(call, leaves))
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    assert_same_bits(torch.autograd.grad(loss, leaves), first)
    with pytest.raises(RuntimeError, match="a second time"):
        torch.autograd.grad(loss, leaves)


@pytest.mark.parametrize("name", NAMES)
def test_what_changed_under_the_graph_is_no_gradient(name):
    call, inputs = cases()[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    loss = weighted(outputs(call, leaves))
    with torch.no_grad():
        for leaf in leaves:
            leaf.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        torch.autograd.grad(loss, leaves)


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_nothing_lives_longer_than_its_graph(name, backward):
    call, inputs = cases()[name]
    gc.collect()
    gc.disable()  # reference counts alone have to do it: a cycle would hold the memory until the next collection
    try:
        leaves = [tensor.clone().requires_grad_() for tensor in inputs]
        out = outputs(call, leaves)
        if backward:
            torch.autograd.grad(weighted(out), leaves)
        watched = [weakref.ref(tensor) for tensor in (*leaves, *out)]
        del leaves, out
        assert not any(tensor() is not None for tensor in watched)
    finally:
        gc.enable()


@pytest.mark.parametrize("name", NAMES)
def test_checkpoints_and_hooks_find_what_they_look_for(name):
    call, inputs = cases()[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    out = torch.utils.checkpoint.checkpoint(lambda *leaves: tuple(outputs(call, leaves)), *leaves, use_reentrant=False)
    seen = []
    out[0].register_hook(seen.append)
    grads = torch.autograd.grad(weighted(out), leaves)
    plain = results(name)
    assert_same_bits([*(o.detach() for o in out), *grads], plain)
    assert torch.equal(seen[0], 2 * plain[0])  # of its square


def opposite(tensor):
    """`tensor` as torch may hand it out: in memory the negative, with a flag that says so."""
    lazy = torch._neg_view(-tensor)
    assert lazy.is_neg() and torch.equal(lazy.detach(), tensor.detach())
    return lazy


@pytest.mark.parametrize("name", NAMES)
def test_memory_that_holds_the_opposite_is_read_as_what_it_stands_for(name):
    assert_same_bits(results(name, opposite), results(name))
    call, inputs = cases()[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    out = [o for o in outputs(call, leaves) if o.requires_grad]
    incoming = [torch.rand_like(o) for o in out]
    plain = torch.autograd.grad(out, leaves, incoming, retain_graph=True)
    assert_same_bits(torch.autograd.grad(out, leaves, [opposite(g) for g in incoming]), plain)


class Labelled(torch.Tensor):
    """A tensor of a user's own kind."""


@pytest.mark.parametrize("name", NAMES)
def test_other_kinds_of_tensors_and_default_devices_change_nothing(name, as_shipped):
    plain = results(name)
    assert_same_bits(results(name, lambda leaf: leaf.as_subclass(Labelled)), plain)
    call, inputs = cases()[name]
    parameters = [torch.nn.Parameter(tensor.clone()) for tensor in inputs]
    out = outputs(call, parameters)
    assert_same_bits([*(o.detach() for o in out), *torch.autograd.grad(weighted(out), parameters)], plain)
    if not name.startswith("rasterization"):  # which makes tensors itself
        with torch.device("meta"):
            elsewhere = outputs(call, inputs)
        assert_same_bits(elsewhere, plain[: len(elsewhere)])


def test_transforms_of_functions_go_through_torch():
    directions, coefficients = spherical_harmonics()[1]
    one_by_one = torch.stack([ops.spherical_harmonics(3, d, coefficients[0]) for d in directions])
    with warnings.catch_warnings(action="ignore"):  # that it is slow
        mapped = torch.func.vmap(lambda d: ops.spherical_harmonics(3, d, coefficients[0]))(directions)
    assert torch.equal(mapped, one_by_one)
