"""Operators under the transforms of torch.func: gradients and vmap are right, what does not exist is refused."""

import pytest
import torch
from operator_calls import ONE_OF_EACH, calls, weights_of
from torch.autograd import forward_ad

from oasis_warp import ops
from oasis_warp.ops import DECLARATIONS

pytestmark = [
    pytest.mark.usefixtures("as_shipped"),
    pytest.mark.filterwarnings("ignore:.torch.jit.script:DeprecationWarning"),  # which torch's own jvp uses
]
EACH = pytest.mark.parametrize("name", ONE_OF_EACH)
DRAWN = tuple(name for name in ONE_OF_EACH if name.startswith("rasterization"))


def loss(call):
    """A random weighting of those results that have a gradient, as a function of the inputs."""
    out = call.function(*call.leaves())
    weights = [(w if part.requires_grad else 0 * w) for part, w in zip(out, weights_of(out), strict=True)]
    return lambda *inputs: sum((part * w).sum() for part, w in zip(call.function(*inputs), weights, strict=True))


@EACH
@pytest.mark.parametrize("kind", ["jvp", "jacfwd", "dual numbers", "jvp of a gradient"])
def test_a_derivative_in_forward_mode_is_refused_in_words(name, kind):
    # It was zero without a word.
    call = calls(n_poses=2)[name]
    inputs = tuple(call.inputs)
    with pytest.raises(RuntimeError, match=f"^{call.operator}: expected a derivative in reverse mode, got one in forw"):
        if kind == "jvp":
            torch.func.jvp(call.function, inputs, inputs)
        elif kind == "jacfwd":
            torch.func.jacfwd(call.function)(*inputs)
        elif kind == "jvp of a gradient":
            torch.func.jvp(torch.func.grad(loss(call)), inputs, inputs)
        else:
            with forward_ad.dual_level():
                call.function(*(forward_ad.make_dual(tensor, tensor) for tensor in inputs))


@pytest.mark.parametrize("name", ["depth_map", "rest_mesh", "blend_weights"])
def test_operators_without_a_gradient_refuse_forward_mode_too(name):
    made = calls()
    scene, seen = made["rasterization"].arguments, made["depth_visibility"].arguments
    arguments = {
        "depth_map": {key: seen[key] for key in ("vertices", "faces", "viewmat", "K", "width", "height")},
        "rest_mesh": {key: made["face_rotations"].arguments[key] for key in ("rest_vertices", "faces")},
        "blend_weights": {key: scene[key] for key in ("means", "quats", "scales", "opacities", "width", "height")}
        | {"viewmat": scene["viewmats"][0], "K": scene["Ks"][0]},
    }[name]
    first, tensor = next(iter(arguments.items()))
    with pytest.raises(RuntimeError, match=f"^{name}: expected a derivative in reverse mode"):
        torch.func.jvp(lambda x: DECLARATIONS[name].function(**arguments | {first: x})[-1], (tensor,), (tensor,))


@EACH
def test_gradients_by_torch_func_are_those_of_backward(name):
    call = calls(n_poses=2)[name]
    leaves, places = call.leaves(), tuple(range(len(call.inputs)))
    want = torch.autograd.grad(loss(call)(*leaves), leaves)
    found = torch.func.grad(loss(call), argnums=places)(*call.inputs)
    assert all(torch.equal(a, b) for a, b in zip(found, want, strict=True))
    pull = torch.func.vjp(loss(call), *call.inputs)[1]
    assert all(torch.equal(a, b) for a, b in zip(pull(torch.tensor(1.0)), want, strict=True))


@EACH
def test_jacobians_have_a_gradient_in_each_row(name):
    call = calls(n_poses=2)[name]
    (leaf, *others), some = call.leaves(), slice(0, 3)
    place = next(k for k, part in enumerate(call.function(leaf, *others)) if part.requires_grad)
    picked = lambda first: call.function(first, *call.inputs[1:])[place].flatten()[some]  # noqa: E731
    rows = [torch.autograd.grad(value, leaf, retain_graph=True)[0] for value in picked(leaf)]
    torch.testing.assert_close(torch.func.jacrev(picked)(call.inputs[0]), torch.stack(rows), rtol=1e-6, atol=1e-6)


@EACH
def test_a_second_derivative_by_torch_func_is_refused(name):
    call = calls(n_poses=2)[name]
    (first, *others), weighted = call.inputs, loss(call)
    gradient = torch.func.grad(lambda x: weighted(x, *others))
    with pytest.raises(RuntimeError, match=f"^{call.operator}: expected one derivative, got a request for the second"):
        torch.func.grad(lambda x: gradient(x).sum())(first)


@EACH
def test_vmap_gives_the_results_and_the_gradients_of_a_loop(name):
    call = calls(n_poses=2)[name]
    stacked = [torch.stack([tensor, 1.01 * tensor]) for tensor in call.inputs]
    with torch.no_grad():
        mapped = torch.func.vmap(call.function)(*stacked)
    for k in range(2):
        alone = call.function(*(tensor[k] for tensor in stacked))
        assert all(torch.equal(a[k], b) for a, b in zip(mapped, alone, strict=True))
    leaves = [tensor.clone().requires_grad_() for tensor in stacked]
    if name in DRAWN:
        with pytest.raises(RuntimeError, match="^rasterization: expected one call whose gradient is wanted, got vmap"):
            torch.func.vmap(loss(call))(*leaves)
        return
    want = torch.autograd.grad(sum(loss(call)(*(leaf[k] for leaf in leaves)) for k in range(2)), leaves)
    # What the adjoint needs was not kept: a segmentation fault.
    found = torch.autograd.grad(torch.func.vmap(loss(call))(*leaves).sum(), leaves)
    for others in (found, torch.func.vmap(torch.func.grad(loss(call), tuple(range(len(leaves)))))(*stacked)):
        assert all(torch.equal(a, b) for a, b in zip(others, want, strict=True))


def test_colours_blend_linearly_in_every_mode():
    scene = calls(dtype=torch.float64)["rasterization"].arguments
    gaussians = {key: scene[key] for key in ("means", "quats", "scales", "opacities", "width", "height")}
    weights = ops.blend_weights(**gaussians, viewmat=scene["viewmats"][0], K=scene["Ks"][0])
    colors = scene["colors"]
    blend = lambda x: ops.blend_colors(weights, x)  # noqa: E731
    drawn = torch.func.jvp(blend, (colors,), (2 * colors,))
    assert torch.equal(drawn[1], 2 * drawn[0])
    several = torch.stack([colors, 2 * colors, 3 * colors], 1)
    mapped = torch.func.vmap(blend, in_dims=1)(several)
    torch.testing.assert_close(mapped, torch.stack([blend(several[:, k]) for k in range(3)]), rtol=1e-12, atol=0)
    assert torch.autograd.gradcheck(blend, colors.clone().requires_grad_())
    assert torch.autograd.gradgradcheck(lambda x: blend(x * x), colors.clone().requires_grad_())


@pytest.mark.parametrize(
    ("name", "key"),
    [("rasterization", "Ks"), ("depth_visibility", "K"), ("depth_visibility", "viewmat"), ("bone_transforms", "axes")],
)
def test_a_gradient_that_does_not_exist_is_refused_and_not_none(name, key):
    arguments = calls()[name].arguments
    wanted = arguments | {key: arguments[key].clone().requires_grad_()}
    with pytest.raises(ValueError, match=rf"^{key}: expected a tensor that needs no gradient.*pass {key}.detach\(\)"):
        DECLARATIONS[name].function(**wanted)
    with torch.no_grad():
        DECLARATIONS[name].function(**wanted)
