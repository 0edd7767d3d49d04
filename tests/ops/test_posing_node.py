"""Posing by two nodes of autograd: what the four operators give apart, to the bit."""

from typing import Any

import pytest
import torch

from oasis_kernels.posing import face_rotation_native as rotations
from oasis_kernels.posing import mesh_gaussians
from oasis_kernels.skinning import kinematics
from oasis_kernels.skinning import skinning_native as skinning
from oasis_warp.ops import pose_mesh_gaussians, rest_mesh, skinned_vertices
from oasis_warp.ops._runtime import posing_node
from oasis_warp.ops._runtime.posing_plan import ORDERS

V, F, J = 80, 140, 16
POSE = {"angles", "orientation", "translation"}
RIDERS = {"barycentrics", "offsets", "quats", "scales"}


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


def scene(p, q, correctives, seed=0) -> list[dict[str, Any]]:
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
    bones, bound = scene(p, q, correctives)
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
    bones, bound = scene(7, 300, True)
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
    bones, bound = scene(7, 300, True)
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
