"""Gaussians on a posed mesh: laws, hard cases, caches, arguments that go together; two nodes of autograd on CUDA."""

import gc
import math
import weakref
from typing import Any

import pytest
import torch
from operator_calls import calls, mesh

from oasis_kernels.posing import face_rotation_native as rotations
from oasis_kernels.posing import mesh_gaussians
from oasis_kernels.skinning import kinematics
from oasis_kernels.skinning import skinning_native as skinning
from oasis_warp.core.rotation import from_axis_angle, multiply, to_matrix
from oasis_warp.ops import (
    face_rotations,
    pose_mesh_gaussians,
    pose_on_mesh,
    pose_on_mesh_covars,
    rest_mesh,
    skinned_vertices,
)
from oasis_warp.ops._runtime import posing_node
from oasis_warp.ops._runtime.posing_plan import ORDERS

LAWS = ["sqrt_area", "area", "none"]
FLOATS = ("posed_vertices", "barycentrics", "vertex_quats", "area_ratio", "quats", "scales")
V, F, J = 80, 140, 16
POSE = {"angles", "orientation", "translation"}
RIDERS = {"barycentrics", "offsets", "quats", "scales"}


def on_faces(seed, name="pose_on_mesh faces"):
    """Arguments in float64: 35 Gaussians on a mesh of 25 vertices and 32 faces."""
    return calls(seed, dtype=torch.float64)[name].arguments


def on_both(seed):
    """`on_faces`, with 12 Gaussians on vertices in front of them."""
    return on_faces(seed, "pose_on_mesh")


def test_gaussians_on_vertices_alone_need_no_barycentrics():
    arguments = on_both(4)
    both = pose_on_mesh(**arguments)
    for name, n in {"face_index": 0, "barycentrics": 0, "quats": 12, "scales": 12}.items():
        arguments[name] = arguments[name][:n]
    got = pose_on_mesh(**arguments)
    assert len(got.means) == 12 and all(torch.equal(a, b[:12]) for a, b in zip(got, both, strict=True))


def test_another_mesh_for_the_same_gaussians_is_noticed():
    # Who hangs on which vertex is remembered with `face_index`, but follows from the faces too.
    arguments = on_both(5)
    arguments["posed_vertices"].requires_grad_()
    weights = torch.arange(47.0)[:, None].double()

    def gradient(arguments):
        return torch.autograd.grad((pose_on_mesh(**arguments).means * weights).sum(), arguments["posed_vertices"])[0]

    before = gradient(arguments)
    fresh = {"face_index": arguments["face_index"].clone()}
    for change in ({"faces": arguments["faces"].flip(1)}, {"vertex_index": arguments["vertex_index"].flip(0)}):
        changed = gradient(arguments | change)
        assert not torch.equal(changed, before)
        assert torch.equal(changed, gradient(arguments | change | fresh))
    arguments["faces"][:] = arguments["faces"].flip(1).clone()
    assert torch.equal(gradient(arguments), gradient(arguments | fresh))


def on_a_sheet(seed, dtype=torch.float64):
    """Vertices at rest, faces, and canonical Gaussians on them, whose rotations come from `face_rotations`."""
    generator = torch.Generator().manual_seed(seed)
    rest, _, faces = mesh(seed, 5, dtype)
    q = 2 * len(faces)
    gaussians = {
        "face_index": torch.arange(q) % len(faces),
        "barycentrics": torch.randn(q, 3, generator=generator).to(dtype).softmax(-1),
        "quats": torch.nn.functional.normalize(torch.randn(q, 4, generator=generator).to(dtype), dim=1),
        "scales": torch.randn(q, 3, generator=generator).to(dtype).exp(),
    }
    return rest, faces, gaussians


def carry(rest, posed, faces, gaussians, law="sqrt_area"):
    rotated = face_rotations(rest, posed, faces)
    return pose_on_mesh(
        posed, faces, vertex_quats=rotated.vertex_quats, area_ratio=rotated.area_ratio, scale_law=law, **gaussians
    )


def some_turn(seed=0):
    return to_matrix(torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


@pytest.mark.parametrize("law", LAWS)
def test_the_rest_pose_gives_the_canonical_set_back(law):
    rest, faces, gaussians = on_a_sheet(0)
    got = carry(rest, rest, faces, gaussians, law)
    torch.testing.assert_close(got.quats, gaussians["quats"], rtol=0, atol=1e-14)
    torch.testing.assert_close(got.scales, gaussians["scales"], rtol=1e-14, atol=0)


@pytest.mark.parametrize("law", LAWS)
def test_a_rigid_motion_acts_rigidly_on_means_and_rotations_and_leaves_scales(law):
    rest, faces, gaussians = on_a_sheet(1)
    turn, shift = some_turn(), torch.tensor([1.0, -2, 0.5], dtype=torch.float64)
    still, moved = carry(rest, rest, faces, gaussians, law), carry(rest, rest @ turn.T + shift, faces, gaussians, law)
    torch.testing.assert_close(moved.means, still.means @ turn.T + shift)
    torch.testing.assert_close(to_matrix(moved.quats), turn @ to_matrix(still.quats))
    torch.testing.assert_close(moved.scales, still.scales)


@pytest.mark.parametrize(("law", "power"), [("sqrt_area", 1), ("area", 2), ("none", 0)])
def test_uniform_growth_by_k_multiplies_scales_by_k_with_the_root_of_the_area(law, power):
    rest, faces, gaussians = on_a_sheet(2)
    k = 3.0
    got = carry(rest, k * rest, faces, gaussians, law)
    # The ratio is damped by 0.5e-6 of the longest edge squared, 1e-6 and more of these faces' areas.
    torch.testing.assert_close(got.scales, k**power * gaussians["scales"], rtol=2e-5, atol=0)
    torch.testing.assert_close(got.quats, gaussians["quats"], rtol=0, atol=1e-13)


def test_a_corner_gives_that_vertex_and_its_rotation():
    arguments = on_faces(3)
    corner = torch.arange(35) % 3
    arguments["barycentrics"] = torch.eye(3, dtype=torch.float64)[corner]
    got = pose_on_mesh(**arguments)
    vertex = arguments["faces"][arguments["face_index"], corner]
    assert torch.equal(got.means, arguments["posed_vertices"][vertex])
    torch.testing.assert_close(got.quats, multiply(arguments["vertex_quats"][vertex], arguments["quats"]))


def test_the_order_of_faces_and_corners_does_not_matter():
    arguments = on_faces(5)
    plain = pose_on_mesh(**arguments)
    order = torch.randperm(len(arguments["faces"]), generator=torch.Generator().manual_seed(0))
    other = dict(arguments)
    other["faces"], other["area_ratio"] = arguments["faces"][order], arguments["area_ratio"][order]
    other["face_index"] = order.argsort()[arguments["face_index"]]
    assert all(torch.equal(a, b) for a, b in zip(plain, pose_on_mesh(**other), strict=True))
    rotated = {**arguments, **{key: arguments[key][:, [1, 2, 0]] for key in ("faces", "barycentrics")}}
    for a, b in zip(plain, pose_on_mesh(**rotated), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-14)


def test_opposite_rotations_mix_to_a_rotation_and_never_to_zero():
    # Corners turned by 0, 179.9 and -179.9 degrees about one axis, and by half turns about three.
    degrees = [0.0, 179.9, -179.9]
    about_z = [[math.cos(math.radians(d / 2)), 0, 0, math.sin(math.radians(d / 2))] for d in degrees]
    half_turns = [[0.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    quats = torch.tensor(about_z + half_turns, requires_grad=True)
    generator = torch.Generator().manual_seed(0)
    barycentrics = torch.rand(200, 3, generator=generator) + 1e-3
    barycentrics = (barycentrics / barycentrics.sum(1, keepdim=True)).requires_grad_()
    got = pose_on_mesh(
        torch.rand(6, 3, generator=generator),
        torch.tensor([[0, 1, 2], [3, 4, 5]]),
        torch.arange(200) % 2,
        barycentrics,
        quats,
        torch.ones(2),
        torch.tensor([[1.0, 0, 0, 0]]).expand(200, 4),
        torch.ones(200, 3),
    ).quats
    assert ((got.norm(dim=1) - 1).abs() < 2e-6).all()
    by_quats, by_barycentrics = torch.autograd.grad((got * torch.arange(4)).sum(), [quats, barycentrics])
    assert by_quats.isfinite().all() and by_barycentrics.isfinite().all()
    # |sum| is at least a third, and derivatives of the normalised mean at most its inverse.
    assert by_barycentrics.abs().max() < 3 * 10


def test_a_collapsed_or_torn_face_bounds_the_scale_and_stops_its_gradient():
    arguments = {name: t[:4] if name in ("barycentrics", "quats", "scales") else t for name, t in on_faces(8).items()}
    arguments |= {"face_index": torch.tensor([0, 1, 2, 3]), "scale_law": "sqrt_area"}
    arguments["area_ratio"][:4] = torch.tensor([0.0, 1e-9, 1e9, 4.0], dtype=torch.float64)
    arguments["area_ratio"].requires_grad_()
    got = pose_on_mesh(**arguments)
    growth = (got.scales / arguments["scales"]).detach()
    expected = torch.tensor([1e-2, 1e-2, 1e2, 2.0], dtype=torch.float64)
    torch.testing.assert_close(growth, expected[:, None].expand(4, 3))
    (grad,) = torch.autograd.grad(got.scales.sum(), arguments["area_ratio"])
    assert not grad[:3].any() and grad[3] > 0


def test_barycentrics_that_sum_to_zero_leave_no_nan():
    arguments = on_faces(9)
    arguments["barycentrics"][:2] = 0
    for name in FLOATS:
        arguments[name].requires_grad_()
    got = pose_on_mesh(**arguments)
    assert all(out.isfinite().all() for out in got)
    grads = torch.autograd.grad(sum(out.sum() for out in got), [arguments[name] for name in FLOATS])
    assert all(grad.isfinite().all() for grad in grads)


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_an_index_is_remembered_no_longer_than_it_lives(dtype):
    arguments = on_faces(1)
    index = arguments.pop("face_index").to(dtype)
    first = pose_on_mesh(**arguments, face_index=index)
    assert torch.equal(first.means, pose_on_mesh(**arguments, face_index=index).means)
    gone = weakref.ref(index)
    del index, first
    gc.collect()
    assert gone() is None


def test_indices_made_in_inference_mode_are_accepted():
    with torch.inference_mode():
        arguments = on_faces(1)
        got = pose_on_mesh(**arguments)
    assert torch.equal(got.means, pose_on_mesh(**on_faces(1)).means)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale_law": "jacobian"}, "scale_law: expected one of 'sqrt_area', 'area', 'none', got 'jacobian'."),
        ({"offsets": torch.zeros(9, 3).double()}, "offsets: expected None, got a tensor. It goes with vertex_index."),
        ({"vertex_index": torch.zeros(9).long()}, "offsets: expected a tensor, got None. It goes with vertex_index."),
        (
            {"face_index": torch.full((35,), -1)},
            r"face_index: expected indices in 0 .. 31 \(32 faces\), got values from",
        ),
    ],
)
def test_a_wrong_argument_is_named_with_what_was_expected(change, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        pose_on_mesh(**on_faces(0) | change)


def scene(seed, dtype=torch.float64):
    """Arguments: 35 Gaussians on some of the 32 faces of a rumpled grid."""
    return calls(seed, dtype=dtype)["pose_on_mesh_covars"].arguments


def test_a_rigid_motion_turns_covariances():
    arguments = scene(3)
    turn = from_axis_angle(torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64), torch.tensor(2.5).double())
    arguments["posed_vertices"] = arguments["rest_vertices"]
    still = pose_on_mesh_covars(**arguments)
    arguments["posed_vertices"] = arguments["rest_vertices"] @ turn.T + 5
    moved = pose_on_mesh_covars(**arguments)
    half = to_matrix(arguments["quats"]) * arguments["scales"][:, None]
    torch.testing.assert_close(still.covars, half @ half.transpose(1, 2))
    torch.testing.assert_close(moved.covars, turn @ still.covars @ turn.T)
    torch.testing.assert_close(moved.means, still.means @ turn.T + 5)


def test_a_stretch_in_the_plane_stretches_along_its_direction_only():
    rest = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    posed = rest * torch.tensor([3.0, 0.5, 1.0])
    scales = torch.tensor([[0.2, 0.3, 0.4]], dtype=torch.float64)
    thirds, upright = torch.full((1, 3), 1 / 3).double(), torch.tensor([[1.0, 0, 0, 0]]).double()
    face, index = torch.tensor([[0, 1, 2]]), torch.tensor([0])
    covars = pose_on_mesh_covars(rest, posed, face, index, thirds, upright, scales).covars[0]
    # Along the normal a Gaussian keeps its thickness.
    torch.testing.assert_close(covars, torch.diag(torch.tensor([0.6, 0.15, 0.4]).double() ** 2))


def test_equal_scales_have_a_gradient():
    # An eigenvalue decomposition would divide by the difference of equal eigenvalues.
    arguments = scene(4)
    arguments["posed_vertices"] = arguments["rest_vertices"].clone().requires_grad_()
    arguments["scales"] = torch.ones_like(arguments["scales"])
    covars = pose_on_mesh_covars(**arguments).covars
    (grad,) = torch.autograd.grad((covars * torch.arange(9.0).view(3, 3)).sum(), arguments["posed_vertices"])
    assert grad.isfinite().all() and grad.any()


@pytest.mark.parametrize("flat", ["rest_vertices", "posed_vertices"])
def test_a_flat_face_leaves_covariances_alone_and_has_no_gradient(flat):
    arguments = scene(5)
    a, b, c = arguments["faces"][0]
    arguments["face_index"][:] = 0
    arguments[flat][c] = (arguments[flat][a] + arguments[flat][b]) / 2
    meshes = [arguments[name].requires_grad_() for name in ("rest_vertices", "posed_vertices")]
    covars = pose_on_mesh_covars(**arguments).covars
    half = to_matrix(arguments["quats"]) * arguments["scales"][:, None]
    torch.testing.assert_close(covars.detach(), half @ half.transpose(1, 2))
    assert not any(grad.any() for grad in torch.autograd.grad(covars.sum(), meshes))


def test_parameters_are_given_in_the_order_of_the_kernels():
    """A parameter that is added to a kernel would shift all that follow."""
    kernels = {
        "bone_transforms": kinematics.on_cuda("bone_transforms", "float"), "skin": skinning.cuda_skin,
        "skin_backward": skinning.cuda_skin_backward, "sum_blocks": skinning.cuda_sum_blocks,
        "bone_transforms_backward": kinematics.on_cuda("bone_transforms_backward", "float"),
        "rotate_faces": rotations.rotate_faces, "rotate_vertices": rotations.rotate_vertices,
        "rotate_faces_backward": rotations.rotate_faces_backward, "gather_edges": rotations.gather_edges,
        "pose_mesh_gaussians": mesh_gaussians.pose_mesh_gaussians,
        "gather_mesh_gaussians": mesh_gaussians.gather_mesh_gaussians,
        "pose_mesh_gaussians_backward": mesh_gaussians.pose_mesh_gaussians_backward,
    }  # fmt: skip
    assert {name: " ".join(kernel.parameters) for name, kernel in kernels.items()} == ORDERS


def chain_scene(p, q, correctives, seed=0) -> list[dict[str, Any]]:
    """Arguments of `skinned_vertices` and of `pose_mesh_gaussians` but for the mesh."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=random)

    bones = {
        "angles": 0.4 * normal(J - 1, 3), "orientation": torch.linalg.qr(normal(3, 3))[0], "translation": normal(3),
        "joints": normal(J, 3), "axes": torch.linalg.qr(normal(J, 3, 3))[0].contiguous(), "rest_vertices": normal(V, 3),
        "weights": normal(V, J).softmax(-1), "displacements": 0.1 * normal(V, 3, 2 * (J - 1)) if correctives else None,
    }  # fmt: skip
    bound = {
        "faces": torch.stack([torch.randperm(V, generator=random)[:3] for _ in range(F)]),
        "face_index": torch.randint(F, (q,), generator=random), "barycentrics": normal(q, 3).softmax(-1),
        "vertex_index": torch.randint(V, (p,), generator=random) if p else None,
        "offsets": 0.1 * normal(p, 3) if p else None, "quats": normal(p + q, 4), "scales": normal(p + q, 3).exp(),
    }  # fmt: skip
    return [{k: None if t is None else t.cuda() for k, t in part.items()} for part in (bones, bound)]


def results(bones, bound, wanted, measured, with_vertex_quats):
    """Posed vertices and Gaussians, and the gradients of the `wanted` arguments."""
    bones, bound = (
        {k: t.clone().requires_grad_() if k in wanted and t is not None else t for k, t in part.items()}
        for part in (bones, bound)
    )
    posed = skinned_vertices(**bones, parents=[-1, *(max(0, j - 1 if j % 3 else 0) for j in range(1, J))])
    rest = bones["rest_vertices"]
    rest = rest_mesh(rest, bound["faces"], validate=False) if measured else rest
    gaussians = [
        t for t in pose_mesh_gaussians(rest, posed, **bound, with_vertex_quats=with_vertex_quats) if t is not None
    ]
    leaves = {k: t for k, t in (bones | bound).items() if t is not None and t.requires_grad}
    if leaves:
        sum((t * torch.linspace(-1, 1, t.numel()).view_as(t).to(t)).sum() for t in gaussians).backward()
    return [posed.detach(), *(t.detach() for t in gaussians), *(t.grad for t in leaves.values() if t.grad is not None)]


@pytest.mark.gpu
@pytest.mark.parametrize(("p", "q", "correctives"), [(0, 50, True), (7, 300, True), (200, 5, False)])
@pytest.mark.parametrize(
    "wanted",
    [set(), POSE | RIDERS | {"joints", "rest_vertices"}, RIDERS, {"quats"}, {"translation"}, {"rest_vertices"}],
)
@pytest.mark.parametrize(("measured", "with_vertex_quats"), [(False, True), (True, False)])
def test_two_nodes_give_the_bits_of_the_operators(p, q, correctives, wanted, measured, with_vertex_quats, monkeypatch):
    bones, bound = chain_scene(p, q, correctives)
    plans, plan_of = [], posing_node.plan_of
    monkeypatch.setattr(posing_node, "plan_of", lambda kind: plans.append(plan_of(kind)) or plans[-1])
    results(bones, bound, wanted, measured, with_vertex_quats)
    together = results(bones, bound, wanted, measured, with_vertex_quats)
    assert all(plan is not None for plan in plans[-2:])
    monkeypatch.setattr(posing_node, "plan_of", lambda kind: None)
    apart = results(bones, bound, wanted, measured, with_vertex_quats)
    assert len(together) == len(apart) and all(map(torch.equal, together, apart))


@pytest.mark.gpu
def test_a_table_that_changes_binds_gaussians_anew():
    """A plan remembers which Gaussians lie where; in-place changes and other tensors of the same sizes must count."""
    bones, bound = chain_scene(7, 300, True)
    posed = bones["rest_vertices"] + 1
    for change in (lambda t: t.add_(1), lambda t: t + 2):
        pose_mesh_gaussians(bones["rest_vertices"], posed, **bound)
        pose_mesh_gaussians(bones["rest_vertices"], posed, **bound)
        bound["face_index"].remainder_(F - 3)
        bound["face_index"] = change(bound["face_index"])
        got = pose_mesh_gaussians(bones["rest_vertices"], posed, **bound).means
        fresh = {k: t.clone() for k, t in bound.items()}
        assert torch.equal(got, pose_mesh_gaussians(bones["rest_vertices"], posed, **fresh).means)
        corners = posed[bound["faces"][bound["face_index"]]]
        torch.testing.assert_close(got[7:], (corners * bound["barycentrics"][..., None]).sum(1))


@pytest.mark.gpu
def test_a_second_derivative_of_a_pose_is_refused():
    bones, bound = chain_scene(7, 300, True)
    for _ in range(2):
        scales = bound["scales"].clone().requires_grad_()
        angles = bones["angles"].clone().requires_grad_()
        parents = [-1, *[0] * (J - 1)]
        posed = skinned_vertices(**bones | {"angles": angles}, parents=parents)
        gaussians = pose_mesh_gaussians(bones["rest_vertices"], posed, **bound | {"scales": scales})
        loss = gaussians.scales.square().sum() + gaussians.means.square().sum()
        for gradient in torch.autograd.grad(loss, [scales, angles], create_graph=True):
            with pytest.raises(RuntimeError, match="expected one derivative"):
                gradient.sum().backward(retain_graph=True)
