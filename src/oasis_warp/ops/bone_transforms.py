"""Forward kinematics: joint angles to the transforms that carry each bone's rest points."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.skinning import kinematics as kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._runtime.launch import current_stream, run_cuda, run_native
from oasis_warp.ops._runtime.poses import summed_over_poses
from oasis_warp.ops._runtime.registration import adjoint, differentiable, operator
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops._runtime.words import place, pointer

SCALAR_NAMES = {torch.float32: "float", torch.float64: "double"}


class BoneTransforms(NamedTuple):
    """Bones in a pose."""

    transforms: Float[Tensor, "*B J 3 4"]
    """(R | t) from rest to posed, as `skin` takes them."""
    bends: Float[Tensor, "*B C"]
    """Strengths of pose correctives, C = 2 (J - 1): c and c^2 of each bone but the first, c = 1 - cos(flexion)."""


@functools.cache
def _parents_on(device: torch.device, parents: tuple[int, ...]) -> Tensor:
    # Kept for the life of the process: a copy to the device at every call would wait, and no graph can capture it.
    return torch.tensor(parents, dtype=torch.int32, device=device)


def _outputs(
    angles: Tensor, orientation: Tensor, translation: Tensor, joints: Tensor, axes: Tensor, *_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """Empty tensors for the results and for each bone's own transform, which the adjoint needs."""
    batch, n_joints = angles.shape[:-2], len(joints)
    return (
        angles.new_empty((*batch, n_joints, 3, 4)),
        angles.new_empty((*batch, 2 * (n_joints - 1))),
        angles.new_empty((*batch, n_joints, kernels.LOCAL), dtype=torch.float64),
    )


def _run(name: str, tensors: dict[str, Tensor | None], n_poses: int, n_joints: int, parents: Sequence[int]) -> None:
    """Run a kernel and its namesake for CUDA with contiguous tensors."""
    like = tensors["angles"]
    assert like is not None
    tensors = tensors | {"parents": _parents_on(like.device, tuple(parents))}
    scalar = SCALAR_NAMES[like.dtype]
    words: dict[str, int] = {"n_joints": n_joints, "n_poses": n_poses}
    if like.is_cuda:
        words |= {key: pointer(tensor) for key, tensor in tensors.items()}
        run_cuda(getattr(kernels, f"cuda_{name}")(scalar), words, n_poses, current_stream(like.device))
        return
    state = torch.zeros(kernels.STATE, dtype=torch.int64)
    for key, tensor in {**tensors, "state": state}.items():
        words[key] = 0 if tensor is None else place(tensor, tensor.numel(), tensor.dtype)
    run_native(getattr(kernels, name)(scalar), words, n_poses)


def _bone_transforms(
    angles: Tensor,
    orientation: Tensor,
    translation: Tensor,
    joints: Tensor,
    axes: Tensor,
    parents: list[int],
    validate: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    inputs = {
        "angles": angles,
        "orientation": orientation,
        "translation": translation,
        "joints": joints,
        "axes": axes,
    }
    if validate:
        check_finite(**inputs)
    out = _outputs(*inputs.values())
    tensors = {name: tensor.contiguous() for name, tensor in inputs.items()}
    tensors |= dict(zip(("transforms", "bends", "locals"), out, strict=True))
    _run("transforms", tensors, angles.shape[:-2].numel(), len(joints), parents)
    return out


def _gradients(angles: Tensor, transforms: Tensor, joints: Tensor, needs: list[bool]) -> list[Tensor]:
    """An empty tensor for each input that may have a gradient, of no elements where none is wanted."""
    batch = angles.shape[:-2]
    shapes = (angles.shape, (*batch, 3, 3), (*batch, 3), joints.shape)
    return [angles.new_empty(shape if needed else (0,)) for shape, needed in zip(shapes, needs, strict=True)]


def _fake_backward(
    angles: Tensor, joints: Tensor, axes: Tensor, transforms: Tensor, *others: Any
) -> list[Tensor]:
    return _gradients(angles, transforms, joints, others[-1])


def _bone_transforms_backward(
    angles: Tensor,
    joints: Tensor,
    axes: Tensor,
    transforms: Tensor,
    locals: Tensor,
    parents: list[int],
    grad_transforms: Tensor | None,
    grad_bends: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:
    found = _gradients(angles, transforms, joints, needs)
    batched, n_joints = angles.ndim == 3, len(joints)
    of_poses = angles.new_empty((len(angles), *joints.shape)) if batched and needs[3] else found[3]
    names = ("g_angles", "g_orientation", "g_translation", "g_joints")
    wanted = zip(names, (*found[:3], of_poses), needs, strict=True)
    tensors = {
        "angles": angles.contiguous(),
        "joints": joints.contiguous(),
        "axes": axes.contiguous(),
        "transforms": transforms,
        "locals": locals,
        "g_transforms": None if grad_transforms is None else grad_transforms.contiguous(),
        "g_bends": None if grad_bends is None else grad_bends.contiguous(),
        "sums": torch.empty_like(locals),
        **{name: tensor if needed else None for name, tensor, needed in wanted},
    }
    _run("transforms_backward", tensors, angles.shape[:-2].numel(), n_joints, parents)
    return [*found[:3], summed_over_poses(of_poses, batched and needs[3])]


_operator = operator("bone_transforms", _bone_transforms, _outputs)
_adjoint = adjoint("bone_transforms_backward", _bone_transforms_backward, _fake_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    angles, _, _, joints, axes, parents, _ = inputs
    transforms, _, locals = output
    ctx.mark_non_differentiable(locals)
    ctx.save_for_backward(angles, joints, axes, transforms, locals)
    ctx.parents = parents


def _backward(
    ctx: Any, grad_transforms: Tensor | None, grad_bends: Tensor | None, _: Tensor | None
) -> tuple[Tensor | None, ...]:
    needs = list(ctx.needs_input_grad[:4])
    found = _adjoint(*ctx.saved_tensors, ctx.parents, grad_transforms, grad_bends, needs)
    return (
        *(grad if needed else None for grad, needed in zip(found, needs, strict=True)),
        None,  # axes
        None,  # parents
        None,  # validate
    )


differentiable(_operator, _backward, _save)


def bone_transforms(
    angles: Float[Tensor, "*B A 3"],
    orientation: Float[Tensor, "*B 3 3"],
    translation: Float[Tensor, "*B 3"],
    joints: Float[Tensor, "J 3"],
    axes: Float[Tensor, "J 3 3"],
    parents: Sequence[int],
    *,
    validate: bool = True,
) -> BoneTransforms:
    """Rigid transforms of the bones of a skeleton whose joints bend by `angles`.

    A bone turns about its joint by flexion @ abduction @ twist, rotations about its own three axes at rest, and moves
    with its parent; the first one is carried by `orientation` and `translation`. The strengths of pose correctives that
    come along belong to joints that mostly flex: blend skinning shrinks them by 1 - cos(flexion) to leading order.

    With an axis of poses B before the first three arguments, all poses are worked out in one call, and both outputs
    have that axis too. Differentiable in angles, orientation, translation and joints.

    Args:
        angles: Flexion, abduction and twist [rad] of the bones but the first, shape [J - 1, 3] or [B, J - 1, 3];
            float32 or float64.
        orientation: Rotation of the first bone, shape [3, 3] or [B, 3, 3].
        translation: Where the origin of the rest frame goes [m], shape [3] or [B, 3].
        joints: Where each bone begins at rest [m], shape [J, 3].
        axes: Unit axes of flexion, abduction and twist at rest, a row each, shape [J, 3, 3]; not read for the first.
        parents: Of each bone: -1 for the first, an earlier one for the others.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.

    Raises:
        ValueError: a wrong shape, dtype or parent, or a value that is not finite.
    """
    n_joints = len(parents)
    earlier = all(0 <= parent < bone for bone, parent in enumerate(parents) if bone)
    if not n_joints or parents[0] != -1 or not earlier:
        raise ValueError(f"parents: expected -1, then an earlier bone for each other one, got {list(parents)}.")
    batch = ("B",) if angles.ndim == 3 else ()
    sizes: dict[str, int] = {}
    check_shape("angles", angles, *batch, n_joints - 1, 3, sizes=sizes, hint="One row for each parent but the first.")
    check_shape("orientation", orientation, *batch, 3, 3, sizes=sizes)
    check_shape("translation", translation, *batch, 3, sizes=sizes)
    check_shape("joints", joints, n_joints, 3, hint="One for each parent.")
    check_shape("axes", axes, n_joints, 3, 3, hint="Three for each parent.")
    check_float("angles", angles)
    for name, tensor in (
        ("orientation", orientation),
        ("translation", translation),
        ("joints", joints),
        ("axes", axes),
    ):
        check_float(name, tensor, angles)
    return BoneTransforms(
        *_operator(angles, orientation, translation, joints, axes, list(parents), validate)[:2]
    )
