"""Linear blend skinning of points and covariances, with pose correctives."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.skinning import skinning as kernels
from oasis_kernels.skinning import skinning_native as native_kernels
from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime import launch
from oasis_warp.ops._runtime.declaration import Array, Operator, empty_gradients
from oasis_warp.ops._runtime.launch import launch_ranges
from oasis_warp.ops._runtime.values import check_finite


class Skinned(NamedTuple):
    """Skinned points."""

    means: Float[Tensor, "*B N 3"]
    covars: Float[Tensor, "*B N 3 3"] | None
    """None if none were given."""


def _outputs(
    means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, *_: Any
) -> tuple[Tensor, Tensor]:
    batch = transforms.shape[:-3]
    n_covars = 0 if covars is None else len(means)
    return means.new_empty((*batch, len(means), 3)), means.new_empty((*batch, n_covars, 3, 3))


def _params(means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, **others: Any) -> dict[str, Any]:
    """Parameters of the CPU and CUDA kernels; the inputs are contiguous."""
    return {
        "n": len(means), "n_joints": weights.shape[1], "means": means, "covars": covars, "weights": weights,
        "transforms": transforms, **others,
    }  # fmt: skip


def _cuda_params(
    means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, displacements: Tensor | None,
    strengths: Tensor | None, **others: Any,
) -> dict[str, Any]:  # fmt: skip
    *inputs, displacements, strengths = launch.aligned(means, covars, weights, transforms, displacements, strengths)
    n_correctives = 0 if displacements is None else displacements.shape[-1]
    correctives = {"n_correctives": n_correctives, "displacements": displacements, "strengths": strengths}
    return _params(*inputs, **correctives, **others)


def _corrected(means: Tensor, displacements: Tensor | None, strengths: Tensor | None) -> Tensor:
    """Rest points with the pose correctives of one pose."""
    if displacements is None or strengths is None:
        return means.contiguous()
    # Another layout would change the bits of the product.
    return means.contiguous() + displacements.contiguous() @ strengths.contiguous()


def _skin(
    means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, displacements: Tensor | None,
    strengths: Tensor | None, rotation_only: bool, validate: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    inputs = means, covars, weights, transforms, displacements, strengths
    on_cuda = launch.has_cuda_kernels(means) and not rotation_only
    if transforms.ndim == 4 and not on_cuda:
        return _OPERATOR.each_pose(*inputs, rotation_only, validate)
    out_means, out_covars = _outputs(*inputs)
    if on_cuda:
        n_poses = transforms.shape[:-3].numel()
        params = _cuda_params(*inputs, n_poses=n_poses, out_means=out_means, out_covars=out_covars)
        blocks = launch.block_count(len(means), native_kernels.POINTS)
        blocks *= launch.block_count(n_poses, native_kernels.POSES)
        launch.run_cuda(native_kernels.cuda_skin, params, blocks, launch.current_stream(means.device))
        return out_means, out_covars
    means = _corrected(means, displacements, strengths)
    covars, weights, transforms = launch.contiguous(covars, weights, transforms)
    if means.is_cpu and not rotation_only:
        state = launch.phase_state(native_kernels.STATE)
        params = _params(means, covars, weights, transforms, state=state, out_means=out_means, out_covars=out_covars)
        kernel = native_kernels.on_cpu("skin", launch.SCALAR_NAMES[means.dtype])
        launch.run_native(kernel, params, launch.task_count(len(means)))
    else:
        given = out_covars if covars is None else covars
        launch_ranges(
            kernels.skin,
            len(means),
            [means, given, weights, transforms, int(rotation_only), out_means, out_covars],
            like=means,
        )
    return out_means, out_covars


def _skin_backward(
    means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, displacements: Tensor | None,
    strengths: Tensor | None, rotation_only: bool, g_out_means: Tensor | None, g_out_covars: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    inputs = means, covars, weights, transforms, displacements, strengths
    if launch.has_cuda_kernels(means) and not rotation_only:
        return _skin_backward_on_cuda(inputs, g_out_means, g_out_covars, needs)
    if transforms.ndim == 4:
        return _OPERATOR.each_pose_backward(*inputs, rotation_only, g_out_means, g_out_covars, needs)
    gradients = empty_gradients(inputs, needs)
    needs_means, _, _, needs_transforms, *needs_correctives = needs
    g_means, g_covars, g_weights, g_transforms, *_ = gradients
    if any(needs_correctives):
        g_means = torch.empty_like(means, memory_format=torch.contiguous_format)
    if g_out_covars is None:
        g_covars.zero_()
    corrected, n = _corrected(means, displacements, strengths), len(means)
    covars, weights, transforms, g_out_means, g_out_covars = launch.contiguous(
        covars, weights, transforms, g_out_means, g_out_covars
    )
    g_blends = means.new_empty((n if needs_transforms else 0, 16))
    if means.is_cpu and not rotation_only:
        state = launch.phase_state(native_kernels.STATE)
        params = _params(
            corrected, covars, weights, transforms, state=state, g_out_means=g_out_means, g_out_covars=g_out_covars,
            g_means=g_means, g_covars=g_covars, g_weights=g_weights, g_blends=g_blends,
        )  # fmt: skip
        kernel = native_kernels.on_cpu("skin_backward", launch.SCALAR_NAMES[means.dtype])
        launch.run_native(kernel, params, launch.task_count(n))
    else:
        none = means.new_empty((0, 3, 3))
        given_means = torch.zeros_like(corrected) if g_out_means is None else g_out_means
        given_covars = none if g_out_covars is None else g_out_covars
        arguments = [
            corrected, none if covars is None else covars, weights, transforms, int(rotation_only), given_means,
            given_covars, g_means, none if covars is None else g_covars, g_weights, g_blends,
        ]  # fmt: skip
        launch_ranges(kernels.skin_backward, n, arguments, like=means)
    if needs_transforms:
        _sum_blends(g_blends, weights, g_transforms)
    if any(needs_correctives):
        if needs_means:
            gradients[0] = g_means
        gradients[4:] = _corrective_gradients(g_means, displacements, strengths, gradients[4:], needs_correctives)
    return gradients


def _corrective_gradients(
    by_points: Tensor,
    displacements: Tensor | None,
    strengths: Tensor | None,
    empty: list[Tensor],
    needs: list[bool],
) -> list[Tensor]:
    """Gradients by displacements and strengths from those by the corrected points of every pose, [*B, N, 3]."""
    assert displacements is not None and strengths is not None
    flat, rows, strengths = displacements.contiguous().flatten(0, 1), by_points.flatten(-2), strengths.contiguous()
    g_displacements, g_strengths = empty
    if needs[0]:
        # A matrix product also for one pose: the poses are its inner axis.
        each = rows[None] if rows.ndim == 1 else rows
        g_displacements = (each.T @ strengths.view(len(each), flat.shape[1])).view_as(displacements)
    if needs[1]:
        g_strengths = rows @ flat
    return [g_displacements, g_strengths]


def _sum_blends(g_blends: Tensor, weights: Tensor, g_transforms: Tensor) -> None:
    """Fill the gradients by transforms with sums over points: weight times gradient by the blended transform."""
    n, n_joints = weights.shape
    if not g_blends.is_cpu:
        g_transforms.copy_((weights.T @ g_blends).view(n_joints, 4, 4)[:, :, :3].transpose(1, 2))
        return
    n_blocks = launch.block_count(n, native_kernels.SUM_BLOCK)
    params = {
        "n": n, "n_joints": n_joints, "n_blocks": n_blocks, "weights": weights, "g_blends": g_blends,
        "sums": g_blends.new_empty((n_blocks, n_joints, 16)), "g_transforms": g_transforms,
        "state": launch.phase_state(native_kernels.STATE),
    }  # fmt: skip
    launch.run_native(native_kernels.on_cpu("sum_blends", launch.SCALAR_NAMES[g_blends.dtype]), params, n_blocks)


def _skin_backward_on_cuda(
    inputs: tuple[Any, ...], g_out_means: Tensor | None, g_out_covars: Tensor | None, needs: list[bool]
) -> list[Tensor]:
    means, _, weights, transforms, displacements, strengths = inputs
    n, n_joints = weights.shape
    batch, n_poses = transforms.shape[:-3], transforms.shape[:-3].numel()
    point_blocks = launch.block_count(n, native_kernels.BLOCK)
    gradients = empty_gradients(inputs, [False, False, False, needs[3], False, False])

    def of_each_pose(needed: bool, shared: Tensor) -> Tensor:
        return means.new_empty((*batch, n, *shared.shape[1:])) if needed else shared

    by_points = of_each_pose(needs[0] or any(needs[4:]), gradients[0])
    by_covars, by_weights = of_each_pose(needs[1], gradients[1]), of_each_pose(needs[2], gradients[2])
    if g_out_covars is None:
        by_covars.zero_()
    sums = means.new_empty((n_poses, point_blocks, n_joints, 12)) if needs[3] else None
    stream = launch.current_stream(means.device)
    g_out_means, g_out_covars = launch.contiguous(g_out_means, g_out_covars)
    params = _cuda_params(
        *inputs, g_out_means=g_out_means, g_out_covars=g_out_covars, g_means=by_points, g_covars=by_covars,
        g_weights=by_weights, sums=sums,
    )  # fmt: skip
    launch.run_cuda(native_kernels.cuda_skin_backward, params, n_poses * point_blocks, stream)
    if sums is not None:
        params = {"n_joints": n_joints, "n_sums": point_blocks, "sums": sums, "g_transforms": gradients[3]}
        blocks = n_poses * launch.block_count(12 * n_joints, native_kernels.BLOCK)
        launch.run_cuda(native_kernels.cuda_sum_blocks, params, blocks, stream)
    if any(needs[4:]):
        gradients[4:] = _corrective_gradients(by_points, displacements, strengths, gradients[4:], needs[4:])
    for k, by_pose in enumerate((by_points, by_covars, by_weights)):
        if needs[k]:
            gradients[k] = torch.sum(by_pose, 0) if batch else by_pose
    return gradients


_OPERATOR = Operator(
    "skin",
    _skin,
    _outputs,
    _skin_backward,
    inputs={
        "means": Array("N 3", grad=True),
        "covars": Array("N 3 3", grad=True, optional=True, hint="One for each mean."),
        "weights": Array("N J", grad=True, hint="One row for each mean."),
        "transforms": Array("*B J R 4", grad=True, hint="One for each column of the weights."),
        "displacements": Array("N 3 C", grad=True, optional=True, hint="One row for each mean."),
        "strengths": Array("*B C", grad=True, optional=True, hint="One for each displacement of a mean."),
    },
    outputs={"out_means": "*B N 3", "out_covars": "*B N 3 3"},
    reference="posing.skin",
)


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
    (OASIS, MM '26, eq. 8). With `rotation_only` it becomes R covariance R^T, R the rotation nearest to G (the polar
    factor; proper even where G mirrors). Where that rotation is not unique it passes no gradient. Pose correctives
    first move means to mean + sum_c strength_c displacement_c, as the pose blend shapes of SMPL (Loper et al. 2015,
    eq. 8).

    With an axis of poses B before the transforms and the strengths, one call computes all poses, and every output has
    that axis too. The results are those of as many calls. Differentiable in every float argument.

    Args:
        means: Points at rest [m], shape [N, 3], float32 or float64; N may be 0.
        covars: Covariances at rest [m^2], shape [N, 3, 3]; None for points alone.
        weights: Share of each transform, rows of sum 1, shape [N, J]. Dense: J is meant to be small.
        transforms: Rest to posed, shape [J, 4, 4], the last row taken for 0 0 0 1, or without it, shape [J, 3, 4]; or
            those of B poses, shape [B, J, 4, 4] or [B, J, 3, 4].
        displacements: Shift of each mean by each corrective at strength 1 [m], shape [N, 3, C].
        strengths: Strengths of the correctives, shape [C] or [B, C]. Goes with `displacements`.
        rotation_only: Rotate covariances without stretching them.
        validate: Check the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.

    Raises:
        TypeError: what should be a tensor is none.
        ValueError: a wrong shape or dtype, a value that is not finite, `rotation_only` without covariances, or only one
            of the two arguments of correctives.
    """
    if covars is None and rotation_only:
        raise ValueError("rotation_only: expected False without covars, got True. It says how covariances turn.")
    if (displacements is None) != (strengths is None):
        missing, given = ("displacements", "strengths") if displacements is None else ("strengths", "displacements")
        raise ValueError(f"{missing}: expected a tensor, got None. It goes with {given}.")
    rows = 3 if isinstance(transforms, Tensor) and transforms.ndim >= 3 and transforms.shape[-2] == 3 else 4
    _OPERATOR.check(
        {"R": rows}, means=means, covars=covars, weights=weights, transforms=transforms, displacements=displacements,
        strengths=strengths,
    )  # fmt: skip
    affine = transforms if rows == 3 else transforms[..., :3, :]
    if validate and rows == 4 and not is_traced():
        check_finite(transforms=transforms[..., 3, :].contiguous())  # which the operator does not get
    out_means, out_covars = _OPERATOR(means, covars, weights, affine, displacements, strengths, rotation_only, validate)
    return Skinned(out_means, None if covars is None else out_covars)
