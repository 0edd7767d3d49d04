"""Float32 posing on CUDA as two nodes of autograd, used once the operators have checked a call of the same kind."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import Function

from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime.plans import Plans, differentiable_once, shapes_of
from oasis_warp.ops._runtime.posing_plan import (
    GaussianInputs,
    GaussiansPlan,
    MeshBinding,
    SkinningInputs,
    SkinningPlan,
)
from oasis_warp.ops._runtime.transforms import in_forward_mode

Kind = tuple[Any, ...]
_plans = Plans()
ROW = 16
"""Kernels read rows of four numbers as one [bytes]."""


def kind_of(given: SkinningInputs | GaussianInputs, others: tuple[Any, ...]) -> Kind | None:
    """Key of the plan for a call; None where only the separate operators can run it.

    Args:
        given: Float tensors.
        others: What else a plan depends on.
    """
    first = given[0]
    if not (isinstance(first, Tensor) and first.is_cuda) or is_traced() or in_forward_mode():
        return None
    index = first.get_device()
    shapes = shapes_of(given, index)
    if shapes is None:
        return None
    for tensor in given:
        if tensor is not None and (not tensor.is_contiguous() or tensor.data_ptr() % ROW):
            return None
    return index, type(given), others, *shapes


def plan_of(kind: Kind | None) -> Any:
    """The plan for calls of this kind, if the operators have run one before; else None."""
    return None if kind is None else _plans.plans.get(kind)


def remember_skinning(kind: Kind, given: SkinningInputs, parents: Tensor) -> None:
    """Plan the next call of this kind, which the operators have just checked."""
    if given.angles.ndim == 2:
        _plans.keep(kind, SkinningPlan(given, parents))


def remember_mesh_gaussians(kind: Kind, given: GaussianInputs, binding: MeshBinding) -> None:
    """Plan the next call of this kind, which the operators have just checked."""
    if given.posed_vertices.ndim == 2 and len(given.posed_vertices) and len(binding.face_index):
        _plans.keep(kind, GaussiansPlan(given, binding))


def skin_surface(plan: SkinningPlan, given: SkinningInputs) -> Tensor:
    """Posed vertices."""
    return _skinning(plan, *given) if _tracked(given) else plan.pose(given)[0]


def pose_mesh_gaussians(
    plan: GaussiansPlan, given: GaussianInputs, binding: MeshBinding, with_vertex_quats: bool
) -> tuple[Any, ...]:
    """Means, quaternions and scales; and with `with_vertex_quats` the rotations of vertices, else None."""
    if _tracked(given):
        return _mesh_gaussians(plan, binding, with_vertex_quats, *given)
    *out, workspace = plan.pose(given, binding, keep=False)
    return *out, plan.vertex_quats(workspace) if with_vertex_quats else None


def _tracked(given: Sequence[Tensor | None]) -> bool:
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in given)


class _Skinning(Function):
    @staticmethod
    def forward(ctx: Any, plan: SkinningPlan, *tensors: Tensor | None) -> Tensor:
        posed, ctx.workspace = plan.pose(SkinningInputs(*tensors))  # pyright: ignore[reportArgumentType]
        ctx.save_for_backward(*tensors)
        ctx.plan = plan
        return posed

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        given = SkinningInputs(*ctx.saved_tensors)
        found = ctx.plan.backward(given, ctx.workspace, gradient.contiguous(), ctx.needs_input_grad[1:])
        return None, *differentiable_once("skin", given, [*found, None, None, None])


class _MeshGaussians(Function):
    @staticmethod
    def forward(
        ctx: Any, plan: GaussiansPlan, binding: MeshBinding, with_vertex_quats: bool, *tensors: Tensor | None
    ) -> Any:
        needs = ctx.needs_input_grad[3:]
        surface = needs[0] or needs[1]
        given = GaussianInputs(*tensors)  # pyright: ignore[reportArgumentType]
        *out, ctx.workspace = plan.pose(given, binding, keep=surface)
        ctx.save_for_backward(*tensors)
        ctx.plan, ctx.binding = plan, binding
        ctx.set_materialize_grads(False)
        quats = plan.vertex_quats(ctx.workspace) if with_vertex_quats else None
        if quats is not None and not surface:
            ctx.mark_non_differentiable(quats)
        return *out, quats

    @staticmethod
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple[Any, ...]:
        given = GaussianInputs(*ctx.saved_tensors)
        if all(gradient is None for gradient in incoming):
            return (None,) * (3 + len(given))
        found = ctx.plan.backward(given, ctx.binding, ctx.workspace, incoming, ctx.needs_input_grad[3:])
        return None, None, None, *differentiable_once("pose_on_mesh", given, found)


# Below Function.apply, which takes 3 us to look for functorch: `is_traced` has.
_skinning: Callable[..., Any] = super(Function, _Skinning).apply  # pyright: ignore[reportAttributeAccessIssue]
_mesh_gaussians: Callable[..., Any] = super(Function, _MeshGaussians).apply  # pyright: ignore[reportAttributeAccessIssue]
