"""Many poses in one call are what as many calls give; a mesh that was measured at rest poses like its vertices."""

import pytest
import torch
from test_posing_operators import N_POSES, calls, mesh, weighted_gradients

from oasis_warp.ops import RestMesh, face_rotations, rest_mesh, skin

SHARED = {  # of each operator's floats, those that all poses share
    "bone_transforms poses": {3},
    "face_rotations poses": {0},
    "pose_on_mesh poses": {1, 4, 5, 6},
    "skin poses": {0, 1, 2, 4},
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SHARED)
def test_many_poses_in_one_call_are_what_as_many_calls_give(name, dtype, device):
    function, inputs = calls(dtype=dtype, device=device)[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    together = function(*leaves)
    alone = [
        function(*(leaf if place in SHARED[name] else leaf[k] for place, leaf in enumerate(leaves)))
        for k in range(N_POSES)
    ]
    stacked = [torch.stack(parts) for parts in zip(*alone, strict=True)]
    assert all(torch.equal(a, b) for a, b in zip(together, stacked, strict=True))
    for a, b in zip(weighted_gradients(together, leaves), weighted_gradients(stacked, leaves), strict=True):
        # The poses' shares of a gradient add up in another order.
        assert (a - b).norm() <= (2e-6 if dtype == torch.float32 else 1e-14) * b.norm()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SHARED)
def test_no_poses_give_empty_results_and_zero_gradients(name, dtype, device):
    function, inputs = calls(dtype=dtype, device=device)[name]
    leaves = [
        (tensor if place in SHARED[name] else tensor[:0]).clone().requires_grad_()
        for place, tensor in enumerate(inputs)
    ]
    out = function(*leaves)
    assert all(len(part) == 0 for part in out)
    for grad, leaf in zip(weighted_gradients(out, leaves), leaves, strict=True):
        assert grad.shape == leaf.shape and not grad.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [1, 3, 17])
def test_a_mesh_measured_at_rest_poses_like_its_vertices(n, dtype, device):
    rest, posed, faces = (part.to(device) for part in mesh(2, n, dtype))
    leaf = posed.clone().requires_grad_()
    plain, measured = face_rotations(rest, leaf, faces), face_rotations(rest_mesh(rest, faces), leaf, faces)
    assert all(torch.equal(a, b) for a, b in zip(plain, measured, strict=True))
    assert torch.equal(*(weighted_gradients(turned, [leaf])[0] for turned in (plain, measured)))


def test_measuring_and_posing_compile_into_one_graph(as_shipped):
    rest, posed, faces = mesh(2, 3, torch.float32)

    def turned(posed):
        return tuple(face_rotations(rest_mesh(rest, faces), posed, faces))

    torch._dynamo.reset()
    compiled = torch.compile(turned, fullgraph=True, backend="aot_eager")
    found = []
    for function in (turned, compiled):
        leaf = posed.clone().requires_grad_()
        out = function(leaf)
        found.append([*out, *weighted_gradients(out, [leaf])])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_torch_is_told_of_a_rest_mesh_is_true(dtype):
    rest, _, faces = mesh(2, 3, dtype)
    torch.library.opcheck(torch.ops.oasis_warp.rest_mesh.default, (rest, faces, True))


def test_a_mesh_measured_at_rest_may_have_flat_faces_and_points(device):
    rest, posed, faces = (part.to(device) for part in mesh(2, 2, torch.float32))
    rest[faces[0]] = rest[faces[0, 0]].clone()
    rest[faces[3, 1]] = (rest[faces[3, 0]] + rest[faces[3, 2]]) / 2
    plain, measured = (face_rotations(r, posed, faces) for r in (rest, rest_mesh(rest, faces)))
    for a, b in zip(plain, measured, strict=True):
        assert a.isfinite().all() and torch.equal(a, b)


def test_a_mesh_measured_at_rest_gets_no_gradient():
    rest, posed, faces = mesh(2, 2, torch.float32)
    still = rest_mesh(rest.requires_grad_(), faces)
    turned = face_rotations(still, posed.requires_grad_(), faces)
    (grad,) = torch.autograd.grad(turned.vertex_quats.sum(), posed)
    assert grad.any() and not still.vertices.requires_grad and not still.triangles.requires_grad


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        (RestMesh(torch.zeros(9, 2), torch.zeros(8, 12)), r"rest_vertices: expected shape \[V, 3\], got \[9, 2\]."),
        (RestMesh(torch.zeros(9, 3), torch.zeros(7, 12)), r"rest_vertices.triangles: expected shape \[8, 12\], got"),
        (
            RestMesh(torch.zeros(9, 3), torch.zeros(8, 12).double()),
            "rest_vertices.triangles: expected torch.float32 on cpu, got torch.float64 on cpu.",
        ),
    ],
)
def test_a_rest_mesh_of_something_else_is_refused(rest, message, as_shipped):
    _, posed, faces = mesh(0, 2, torch.float32)
    with pytest.raises(ValueError, match="^" + message):
        face_rotations(rest, posed, faces)


def test_a_rest_mesh_refuses_what_face_rotations_refuses(as_shipped):
    rest, _, faces = mesh(0, 2, torch.float32)
    with pytest.raises(ValueError, match=r"^faces: expected indices in 0 .. 8 \(9 vertices\)"):
        rest_mesh(rest, faces + 1)
    with pytest.raises(ValueError, match=r"^rest_vertices: expected shape \[V, 3\], got \[9, 2\]."):
        rest_mesh(rest[:, :2], faces)
    with pytest.raises(ValueError, match="^rest_vertices: expected float32 or float64, got float16."):
        rest_mesh(rest.half(), faces)
    rest[2, 1] = torch.nan
    with pytest.raises(ValueError, match="^rest_vertices: expected finite values .* got 1 of 27"):
        rest_mesh(rest, faces)


def test_correctives_shift_points_before_the_bones_carry_them(device):
    generator = torch.Generator().manual_seed(0)
    means, transforms = torch.randn(20, 3, generator=generator), torch.randn(4, 3, 4, generator=generator)
    weights = torch.randn(20, 4, generator=generator).softmax(-1)
    displacements, strengths = torch.randn(20, 3, 5, generator=generator), torch.randn(5, generator=generator)
    inputs = [t.to(device) for t in (means, weights, transforms, displacements, strengths)]
    means, weights, transforms, displacements, strengths = inputs
    got = skin(means, None, weights, transforms, displacements=displacements, strengths=strengths).means
    want = skin(means + displacements @ strengths, None, weights, transforms).means
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"strengths": torch.zeros(5)}, "displacements: expected a tensor, got None. It goes with strengths."),
        ({"displacements": torch.zeros(7, 3, 5)}, "strengths: expected a tensor, got None. It goes with displace"),
        (
            {"displacements": torch.zeros(6, 3, 5), "strengths": torch.zeros(5)},
            r"displacements: expected shape \[7, 3, C\], got \[6, 3, 5\]. One row for each mean.",
        ),
        (
            {"displacements": torch.zeros(7, 3, 5), "strengths": torch.zeros(4)},
            r"strengths: expected shape \[5\], got \[4\]. One for each displacement of a mean.",
        ),
        (
            {"displacements": torch.zeros(7, 3, 5).double(), "strengths": torch.zeros(5)},
            "displacements: expected torch.float32 on cpu, got torch.float64 on cpu.",
        ),
    ],
)
def test_wrong_correctives_are_named_with_what_was_expected(options, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        skin(torch.zeros(7, 3), None, torch.ones(7, 1), torch.zeros(1, 3, 4), **options)


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:The AccumulateGrad node's stream does not match")
@pytest.mark.parametrize("name", [*SHARED, "skin correctives"])
def test_a_graph_that_was_captured_once_follows_new_inputs_forwards_and_backwards(name):
    function, inputs = calls(device="cuda", validate=False)[name]
    _, others = calls(seed=3, device="cuda")[name]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    with torch.no_grad():
        weights = [torch.randn_like(o) for o in function(*leaves)]

    def step():
        out = function(*leaves)
        return [*out, *torch.autograd.grad(list(out), leaves, weights)]

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
    assert all(torch.equal(a, b) for a, b in zip(found, step(), strict=True))
