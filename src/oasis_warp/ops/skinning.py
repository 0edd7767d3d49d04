"""Linear blend skinning of points and covariances, with pose correctives."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.skinning import skinning as kernels
from oasis_kernels.skinning import skinning_native as native_kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._runtime.launch import (
    current_stream,
    even_cuts,
    has_cuda_kernels,
    launch_ranges,
    run_cuda,
    run_native,
    view,
)
from oasis_warp.ops._runtime.poses import at_pose, pose_by_pose, summed_over_poses
from oasis_warp.ops._runtime.registration import adjoint, differentiable, operator
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops._runtime.words import aligned, place, pointer, task_count

SCALAR_NAMES = {torch.float32: "float", torch.float64: "double"}


class Skinned(NamedTuple):
    """Points that followed their bones."""

    means: Float[Tensor, "*B N 3"]
    covars: Float[Tensor, "*B N 3 3"] | None
    """None where none were given."""


def _outputs(
    means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, *_: Any
) -> tuple[Tensor, Tensor]:
    batch = transforms.shape[:-3]
    n_covars = 0 if covars is None else len(means)
    return means.new_empty((*batch, len(means), 3)), means.new_empty((*batch, n_covars, 3, 3))


def _input_words(
    means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, state: Tensor
) -> dict[str, int]:
    n, n_joints, dtype = len(means), len(transforms), means.dtype
    return {
        "n": n,
        "n_joints": n_joints,
        "means": place(means, 3 * n, dtype),
        "covars": place(covars, 9 * n, dtype),
        "weights": place(weights, n * n_joints, dtype),
        "transforms": place(transforms, 12 * n_joints, dtype),
        "state": place(state, native_kernels.STATE, torch.int64),
    }


class _CudaInputs(NamedTuple):
    """Inputs as the CUDA kernels read them."""

    means: Tensor
    covars: Tensor | None
    weights: Tensor
    transforms: Tensor
    displacements: Tensor | None
    strengths: Tensor | None

    @property
    def n_poses(self) -> int:
        return len(self.transforms) if self.transforms.ndim == 4 else 1

    def words(self) -> dict[str, int]:
        """Those of every kernel."""
        return {
            "n": len(self.means),
            "n_joints": self.weights.shape[1],
            "n_correctives": 0 if self.displacements is None else self.displacements.shape[-1],
            **{name: pointer(tensor) for name, tensor in self._asdict().items()},
        }


def _for_cuda(*inputs: Tensor | None) -> _CudaInputs:
    return _CudaInputs(*map(aligned, inputs))


def _skin(
    means: Tensor,
    covars: Tensor | None,
    weights: Tensor,
    transforms: Tensor,
    displacements: Tensor | None,
    strengths: Tensor | None,
    rotation_only: bool,
    validate: bool,
) -> tuple[Tensor, Tensor]:
    if validate:
        check_finite(
            means=means, covars=covars, weights=weights, transforms=transforms, displacements=displacements,
            strengths=strengths,
        )  # fmt: skip
    out_means, out_covars = _outputs(means, covars, weights, transforms)
    if has_cuda_kernels(means) and not rotation_only:
        inputs = _for_cuda(means, covars, weights, transforms, displacements, strengths)
        words = inputs.words() | {
            "n_poses": inputs.n_poses,
            "out_means": pointer(out_means),
            "out_covars": pointer(out_covars),
        }
        blocks = -(-len(means) // native_kernels.POINTS) * -(-inputs.n_poses // native_kernels.POSES)
        run_cuda(native_kernels.cuda_skin, words, blocks, current_stream(means.device))
        return out_means, out_covars
    if transforms.ndim == 4:

        def one(k: int) -> tuple[Tensor, Tensor]:
            strength = at_pose(strengths, k)
            return _skin(means, covars, weights, transforms[k], displacements, strength, rotation_only, False)

        pose_by_pose((out_means, out_covars), len(transforms), one)
        return out_means, out_covars

    means = _corrected(means, displacements, strengths)
    weights, transforms = weights.contiguous(), transforms.contiguous()
    given = out_covars if covars is None else covars.contiguous()
    if means.device.type == "cpu" and not rotation_only:
        state = torch.zeros(native_kernels.STATE, dtype=torch.int64)
        words = _input_words(means, None if covars is None else given, weights, transforms, state) | {
            "out_means": place(out_means, 3 * len(means), means.dtype),
            "out_covars": 0 if covars is None else place(out_covars, 9 * len(means), means.dtype),
        }
        run_native(native_kernels.skin(SCALAR_NAMES[means.dtype]), words, task_count(len(means)))
    else:
        launch_ranges(
            kernels.skin,
            even_cuts(len(means)),
            [*map(view, (means, given, weights, transforms)), int(rotation_only), view(out_means), view(out_covars)],
            like=means,
        )
    return out_means, out_covars


def _corrected(means: Tensor, displacements: Tensor | None, strengths: Tensor | None) -> Tensor:
    """Points at rest as a pose corrects them."""
    if displacements is None or strengths is None:
        return means.contiguous()
    return means + displacements.contiguous() @ strengths.contiguous()  # whose layout would change their product's bits


def _gradients(
    means: Tensor,
    covars: Tensor | None,
    weights: Tensor,
    transforms: Tensor,
    displacements: Tensor | None,
    strengths: Tensor | None,
    rotation_only: bool,
    grad_means: Tensor | None,
    grad_covars: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:
    """An empty tensor for each float input, of no rows where no gradient is wanted."""
    inputs = (means, covars, weights, transforms, displacements, strengths)
    return [
        means.new_empty((len(tensor) if needed else 0, *tensor.shape[1:])) if tensor is not None else means.new_empty(0)
        for tensor, needed in zip(inputs, needs, strict=True)
    ]


_SHARED = (True, True, True, False, True, False)
"""Of the float inputs, those that all poses share."""


def _skin_backward(
    means: Tensor,
    covars: Tensor | None,
    weights: Tensor,
    transforms: Tensor,
    displacements: Tensor | None,
    strengths: Tensor | None,
    rotation_only: bool,
    grad_means: Tensor | None,
    grad_covars: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:
    if has_cuda_kernels(means) and not rotation_only:
        inputs = _for_cuda(means, covars, weights, transforms, displacements, strengths)
        return _backward_on_cuda(inputs, grad_means, grad_covars, needs)
    found = _gradients(
        means, covars, weights, transforms, displacements, strengths, rotation_only, grad_means, grad_covars, needs
    )
    if transforms.ndim == 4:

        def one(k: int) -> list[Tensor]:
            of_pose = at_pose(grad_means, k), at_pose(grad_covars, k), needs
            strength = at_pose(strengths, k)
            return _skin_backward(
                means, covars, weights, transforms[k], displacements, strength, rotation_only, *of_pose
            )

        pose_by_pose(found, len(transforms), one, _SHARED)
        return found

    needs_means, needs_covars, needs_weights, needs_transforms, needs_displacements, needs_strengths = needs
    by_means, by_covars, by_weights, by_transforms, *_ = found
    if needs_displacements or needs_strengths:
        by_means = torch.empty_like(means, memory_format=torch.contiguous_format)
    if grad_covars is None:
        by_covars.zero_()
    corrected = _corrected(means, displacements, strengths)
    weights, transforms = weights.contiguous(), transforms.contiguous()
    n, n_joints = len(means), len(transforms)
    by_blends = means.new_empty((n if needs_transforms else 0, 16))
    if means.device.type == "cpu" and not rotation_only:
        dtype = means.dtype
        given = [None if t is None else t.contiguous() for t in (covars, grad_means, grad_covars)]
        state = torch.zeros(native_kernels.STATE, dtype=torch.int64)
        words = _input_words(corrected, given[0], weights, transforms, state) | {
            "g_out_means": place(given[1], 3 * n, dtype),
            "g_out_covars": place(given[2], 9 * n, dtype),
            "g_means": place(by_means if len(by_means) else None, 3 * n, dtype),
            "g_covars": place(by_covars if needs_covars else None, 9 * n, dtype),
            "g_weights": place(by_weights if needs_weights else None, n * n_joints, dtype),
            "g_blends": place(by_blends if needs_transforms else None, 16 * n, dtype),
        }
        run_native(native_kernels.skin_backward(SCALAR_NAMES[dtype]), words, task_count(n))
    else:
        none = means.new_empty((0, 3, 3))
        launch_ranges(
            kernels.skin_backward,
            even_cuts(n),
            [
                *map(view, (corrected, none if covars is None else covars.contiguous(), weights, transforms)),
                int(rotation_only),
                view(torch.zeros_like(corrected) if grad_means is None else grad_means.contiguous()),
                view(none if grad_covars is None else grad_covars.contiguous()),
                *map(view, (by_means, none if covars is None else by_covars, by_weights, by_blends)),
            ],
            like=means,
        )
    if needs_transforms:
        _sum_blends(by_blends, weights, by_transforms)
    if needs_displacements or needs_strengths:
        if needs_means:
            found[0] = by_means
        found[4:] = _corrective_gradients(by_means, displacements, strengths, found[4:], needs[4:])
    return found


def _corrective_gradients(
    by_points: Tensor,
    displacements: Tensor | None,
    strengths: Tensor | None,
    unwanted: list[Tensor],
    needs: list[bool],
) -> list[Tensor]:
    """Gradients of displacements and strengths from those of the corrected points of every pose, [*B, N, 3]."""
    assert displacements is not None and strengths is not None
    flat, rows, strengths = displacements.contiguous().flatten(0, 1), by_points.flatten(-2), strengths.contiguous()
    by_displacements, by_strengths = unwanted
    if needs[0]:
        # A matrix product also for one pose: the poses are its inner axis.
        each = rows[None] if rows.ndim == 1 else rows
        by_displacements = (each.T @ strengths.view(len(each), flat.shape[1])).view_as(displacements)
    if needs[1]:
        by_strengths = rows @ flat
    return [by_displacements, by_strengths]


def _sum_blends(by_blends: Tensor, weights: Tensor, out: Tensor) -> None:
    """Gradients of transforms from those of blended ones: the sum over points of weight times row."""
    n, n_joints = weights.shape
    if by_blends.device.type == "cpu":
        dtype, n_blocks = by_blends.dtype, -(-n // native_kernels.SUM_BLOCK)
        sums = by_blends.new_empty((n_blocks, n_joints, 16))
        state = torch.zeros(native_kernels.STATE, dtype=torch.int64)
        words = {
            "n": n,
            "n_joints": n_joints,
            "n_blocks": n_blocks,
            "weights": place(weights, n * n_joints, dtype),
            "g_blends": place(by_blends, 16 * n, dtype),
            "sums": place(sums, n_blocks * n_joints * 16, dtype),
            "g_transforms": place(out, 12 * n_joints, dtype),
            "state": place(state, native_kernels.STATE, torch.int64),
        }
        run_native(native_kernels.sum_blends(SCALAR_NAMES[dtype]), words, n_blocks)
    else:
        out.copy_((weights.T @ by_blends).view(n_joints, 4, 4)[:, :, :3].transpose(1, 2))


def _backward_on_cuda(
    inputs: _CudaInputs, grad_means: Tensor | None, grad_covars: Tensor | None, needs: list[bool]
) -> list[Tensor]:
    needs_means, needs_covars, needs_weights, needs_transforms, needs_displacements, needs_strengths = needs
    means, transforms = inputs.means, inputs.transforms
    n, n_joints = inputs.weights.shape
    batch, n_poses, batched = transforms.shape[:-3], inputs.n_poses, transforms.ndim == 4
    point_blocks = -(-n // native_kernels.BLOCK)

    def rows(needed: bool, *shape: int) -> Tensor:
        return means.new_empty((*batch, n, *shape)) if needed else means.new_empty((0, *shape))

    by_points = rows(needs_means or needs_displacements or needs_strengths, 3)
    by_covars, by_weights = rows(needs_covars, 3, 3), rows(needs_weights, n_joints)
    if grad_covars is None:
        by_covars.zero_()
    sums = means.new_empty((n_poses, point_blocks, n_joints, 12)) if needs_transforms else None
    by_transforms = transforms.new_empty((len(transforms) if needs_transforms else 0, *transforms.shape[1:]))
    stream = current_stream(means.device)
    given = [None if grad is None else grad.contiguous() for grad in (grad_means, grad_covars)]
    words = inputs.words() | {
        "g_out_means": pointer(given[0]),
        "g_out_covars": pointer(given[1]),
        "g_means": pointer(by_points),
        "g_covars": pointer(by_covars),
        "g_weights": pointer(by_weights),
        "sums": pointer(sums),
    }
    run_cuda(native_kernels.cuda_skin_backward, words, n_poses * point_blocks, stream)
    if sums is not None:
        words = {
            "n_joints": n_joints,
            "n_sums": point_blocks,
            "sums": pointer(sums),
            "g_transforms": pointer(by_transforms),
        }
        run_cuda(native_kernels.cuda_sum_blocks, words, n_poses * -(-12 * n_joints // native_kernels.BLOCK), stream)
    correctives = [
        means.new_empty((0, *(() if tensor is None else tensor.shape[1:])))
        for tensor in (inputs.displacements, inputs.strengths)
    ]
    if needs_displacements or needs_strengths:
        correctives = _corrective_gradients(by_points, inputs.displacements, inputs.strengths, correctives, needs[4:])
    return [
        summed_over_poses(by_points, batched) if needs_means else means.new_empty((0, 3)),
        means.new_empty(0) if inputs.covars is None else summed_over_poses(by_covars, batched and needs_covars),
        summed_over_poses(by_weights, batched and needs_weights),
        by_transforms,
        *correctives,
    ]


_operator = operator("skin", _skin, _outputs)
_adjoint = adjoint("skin_backward", _skin_backward, _gradients)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    if inputs[1] is None:
        ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(*inputs[:6])
    ctx.rotation_only = inputs[6]


def _backward(ctx: Any, grad_means: Tensor | None, grad_covars: Tensor | None) -> tuple[Tensor | None, ...]:
    needs = list(ctx.needs_input_grad[:6])
    found = _adjoint(*ctx.saved_tensors, ctx.rotation_only, grad_means, grad_covars, needs)
    return (
        *(grad if needed else None for grad, needed in zip(found, needs, strict=True)),
        None,  # rotation_only
        None,  # validate
    )


differentiable(_operator, _backward, _save)


def skin(
    means: Float[Tensor, "N 3"],
    covars: Float[Tensor, "N 3 3"] | None,
    weights: Float[Tensor, "N J"],
    transforms: Float[Tensor, "*B J 4 4"] | Float[Tensor, "*B J 3 4"],
    *,
    displacements: Float[Tensor, "N 3 C"] | None = None,
    strengths: Float[Tensor, "*B C"] | None = None,
    rotation_only: bool = False,
    validate: bool = True,
) -> Skinned:
    """Points and their covariances, moved by the weighted mean of rigid or affine transforms (linear blend skinning).

    With the blend (G | t) of a point's transforms, its mean becomes G mean + t and its covariance G covariance G^T
    (OASIS, MM '26, eq. 8), with `rotation_only` R covariance R^T, R the rotation nearest to G (the polar factor; proper
    even where G mirrors). Where that rotation is not unique it passes no gradient. Pose correctives first move means to
    mean + sum_c strength_c displacement_c, as the pose blend shapes of SMPL (Loper et al. 2015, eq. 8).

    With an axis of poses B before the transforms, and the strengths, all poses are worked out in one call, and every
    output has that axis too; it is what as many calls give.

    Differentiable in every float argument.

    Args:
        means: Points at rest [m], shape [N, 3], float32 or float64; N may be 0.
        covars: Covariances at rest [m^2], shape [N, 3, 3]; None for points alone.
        weights: Share of each transform, rows of sum 1, shape [N, J]. Dense: J is meant to be small.
        transforms: Rest to posed, shape [J, 4, 4], the last row taken for 0 0 0 1, or without it, shape [J, 3, 4]; or
            those of B poses, shape [B, J, 4, 4] or [B, J, 3, 4].
        displacements: Shift of each mean by each corrective at strength 1 [m], shape [N, 3, C].
        strengths: How far the pose applies each of them, shape [C] or [B, C]. Goes with `displacements`.
        rotation_only: Turn covariances without stretching them.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.

    Raises:
        ValueError: a wrong shape or dtype, a value that is not finite, `rotation_only` without covariances, or only one
            of the two arguments of correctives.
    """
    sizes: dict[str, int] = {}
    check_shape("means", means, "N", 3, sizes=sizes)
    if covars is not None:
        check_shape("covars", covars, "N", 3, 3, sizes=sizes, hint="One for each mean.")
    elif rotation_only:
        raise ValueError("rotation_only: expected False without covars, got True. It says how covariances turn.")
    check_shape("weights", weights, "N", "J", sizes=sizes, hint="One row for each mean.")
    batch = ("B",) if transforms.ndim == 4 else ()
    rows = 3 if transforms.ndim >= 3 and transforms.shape[-2] == 3 else 4
    check_shape("transforms", transforms, *batch, "J", rows, 4, sizes=sizes, hint="One for each column of the weights.")
    if (displacements is None) != (strengths is None):
        missing, given = ("displacements", "strengths") if displacements is None else ("strengths", "displacements")
        raise ValueError(f"{missing}: expected a tensor, got None. It goes with {given}.")
    if displacements is not None and strengths is not None:
        check_shape("displacements", displacements, "N", 3, "C", sizes=sizes, hint="One row for each mean.")
        check_shape("strengths", strengths, *batch, "C", sizes=sizes, hint="One for each displacement of a mean.")
    check_float("means", means)
    for name, tensor in (
        ("covars", covars),
        ("weights", weights),
        ("transforms", transforms),
        ("displacements", displacements),
        ("strengths", strengths),
    ):
        if tensor is not None:
            check_float(name, tensor, means)
    affine = transforms if rows == 3 else transforms[..., :3, :]
    out_means, out_covars = _operator(
        means, covars, weights, affine, displacements, strengths, rotation_only, validate
    )
    return Skinned(out_means, None if covars is None else out_covars)
