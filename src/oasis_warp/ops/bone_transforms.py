"""Forward kinematics: joint angles to the transforms that carry each bone's rest points."""

import functools
import reprlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.skinning import kinematics as kernels
from oasis_warp.ops._runtime.declaration import Array, Operator
from oasis_warp.ops._runtime.launch import SCALAR_NAMES, contiguous, current_stream, phase_state, run_cuda, run_native


class BoneTransforms(NamedTuple):
    """Bones in a pose."""

    transforms: Float[Tensor, "*B J 3 4"]
    """(R | t) from rest to posed, as `skin` takes them."""
    bends: Float[Tensor, "*B C"]
    """Strengths of pose correctives, C = 2 (J - 1): c and c^2 of each bone but the first, c = 1 - cos(flexion)."""


@functools.cache
def parents_on(device: torch.device, parents: tuple[int, ...]) -> Tensor:
    """The `parents` of bones on a device."""
    # Cached for the life of the process: a copy to the device at every call would wait, and no graph can capture it.
    return torch.tensor(parents, dtype=torch.int32, device=device)


def _outputs(
    angles: Tensor, orientation: Tensor, translation: Tensor, joints: Tensor, axes: Tensor, *_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    batch, n_joints = angles.shape[:-2], len(joints)
    return (
        angles.new_empty((*batch, n_joints, 3, 4)),
        angles.new_empty((*batch, 2 * (n_joints - 1))),
        angles.new_empty((*batch, n_joints, kernels.LOCAL), dtype=torch.float64),
    )


def _run(name: str, params: dict[str, Any], parents: Sequence[int]) -> None:
    """Run the CPU or CUDA kernel of this name with contiguous tensors."""
    like = params["angles"]
    n_poses = like.shape[:-2].numel()
    parent_table = parents_on(like.device, tuple(parents))
    params = params | {"n_joints": len(parents), "n_poses": n_poses, "parents": parent_table}
    scalar = SCALAR_NAMES[like.dtype]
    if like.is_cuda:
        run_cuda(kernels.on_cuda(name, scalar), params, n_poses, current_stream(like.device))
    else:
        params["state"] = phase_state(kernels.STATE)
        run_native(kernels.on_cpu(name, scalar), params, n_poses)


def _bone_transforms(
    angles: Tensor, orientation: Tensor, translation: Tensor, joints: Tensor, axes: Tensor, parents: list[int],
    validate: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    inputs = contiguous(angles, orientation, translation, joints, axes)
    transforms, bends, locals = out = _outputs(*inputs)
    params = dict(zip(_OPERATOR.inputs, inputs, strict=True))
    _run("bone_transforms", params | {"transforms": transforms, "bends": bends, "locals": locals}, parents)
    return out


def _empty_gradients(angles: Tensor, joints: Tensor, axes: Tensor, transforms: Tensor, *others: Any) -> list[Tensor]:
    batch, needs = angles.shape[:-2], others[-1]
    shapes = (angles.shape, (*batch, 3, 3), (*batch, 3), joints.shape)
    return [angles.new_empty(shape if needed else (0,)) for shape, needed in zip(shapes, needs, strict=True)]


def _bone_transforms_backward(
    angles: Tensor, joints: Tensor, axes: Tensor, transforms: Tensor, locals: Tensor, parents: list[int],
    g_transforms: Tensor | None, g_bends: Tensor | None, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    gradients = _empty_gradients(angles, joints, axes, transforms, needs)
    sums_poses = angles.ndim == 3 and needs[3]
    g_joints = angles.new_empty((len(angles), *joints.shape)) if sums_poses else gradients[3]
    angles, joints, axes, g_transforms, g_bends = contiguous(angles, joints, axes, g_transforms, g_bends)
    params = {
        "angles": angles, "joints": joints, "axes": axes, "transforms": transforms, "locals": locals,
        "g_transforms": g_transforms, "g_bends": g_bends, "sums": torch.empty_like(locals), "g_angles": gradients[0],
        "g_orientation": gradients[1], "g_translation": gradients[2], "g_joints": g_joints,
    }  # fmt: skip
    _run("bone_transforms_backward", params, parents)
    return [*gradients[:3], torch.sum(g_joints, 0) if sums_poses else g_joints]


_OPERATOR = Operator(
    "bone_transforms",
    _bone_transforms,
    _outputs,
    _bone_transforms_backward,
    _empty_gradients,
    inputs={
        "angles": Array("*B A 3", grad=True, hint="One row for each parent but the first."),
        "orientation": Array("*B 3 3", grad=True),
        "translation": Array("*B 3", grad=True),
        "joints": Array("J 3", grad=True, hint="One for each parent."),
        "axes": Array("J 3 3", hint="Three for each parent."),
    },
    outputs={"transforms": "*B J 3 4", "bends": "*B C"},
    auxiliary={"locals": "*B J L"},
)


def check_parents(parents: Sequence[int]) -> int:
    """Check that `parents` are those of a skeleton.

    Returns:
        The number of bones.

    Raises:
        TypeError: no sequence of whole numbers.
        ValueError: the first is not -1, or another is no earlier bone.
    """
    if not isinstance(parents, Sequence) or not all(type(parent) is int for parent in parents):
        raise TypeError(f"parents: expected a list of int, got {reprlib.repr(parents)}.")
    earlier = all(0 <= parent < bone for bone, parent in enumerate(parents) if bone)
    if not parents or parents[0] != -1 or not earlier:
        raise ValueError(
            f"parents: expected -1, then an earlier bone for each other one, got {reprlib.repr(list(parents))}."
        )
    return len(parents)


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

    A bone rotates about its joint by flexion @ abduction @ twist, rotations about its own three axes at rest, and moves
    with its parent; `orientation` and `translation` move the first one. `bends` are strengths of pose correctives for
    joints that mostly flex: blend skinning shrinks them by 1 - cos(flexion) to leading order.

    With an axis of poses B before the first three arguments, one call computes all poses, and both outputs have that
    axis too. Differentiable in angles, orientation, translation and joints.

    Args:
        angles: Flexion, abduction and twist [rad] of the bones but the first, shape [J - 1, 3] or [B, J - 1, 3];
            float32 or float64.
        orientation: Rotation of the first bone, shape [3, 3] or [B, 3, 3].
        translation: Posed position of the rest frame's origin [m], shape [3] or [B, 3].
        joints: Start of each bone at rest [m], shape [J, 3].
        axes: Unit axes of flexion, abduction and twist at rest, a row each, shape [J, 3, 3]; not read for the first.
        parents: Parent of each bone: -1 for the first, an earlier bone for the others.
        validate: Check the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.

    Raises:
        TypeError: what should be a tensor, or a list of int, is none.
        ValueError: a wrong shape, dtype or parent, or a value that is not finite.
    """
    n_joints = check_parents(parents)
    _OPERATOR.check(
        {"A": n_joints - 1, "J": n_joints}, angles=angles, orientation=orientation, translation=translation,
        joints=joints, axes=axes,
    )  # fmt: skip
    return BoneTransforms(*_OPERATOR(angles, orientation, translation, joints, axes, list(parents), validate)[:2])
