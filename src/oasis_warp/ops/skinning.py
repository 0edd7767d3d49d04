"""Linear blend skinning of points and covariances."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels import skinning as kernels
from oasis_kernels import skinning_vectors as vector_kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._launch import even_cuts, launch_ranges, run_native, view
from oasis_warp.ops._registration import adjoint, differentiable, operator
from oasis_warp.ops._values import check_finite
from oasis_warp.ops._words import place, task_count

SCALAR_NAMES = {torch.float32: "float", torch.float64: "double"}


class Skinned(NamedTuple):
    """Points that followed their bones."""

    means: Float[Tensor, "N 3"]
    covars: Float[Tensor, "N 3 3"] | None
    """None where none were given."""


def _outputs(means: Tensor, covars: Tensor | None, *_: Any) -> tuple[Tensor, Tensor]:
    return means.new_empty((len(means), 3)), means.new_empty((0 if covars is None else len(means), 3, 3))


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
        "state": place(state, vector_kernels.STATE, torch.int64),
    }


def _skin(
    means: Tensor, covars: Tensor | None, weights: Tensor, transforms: Tensor, rotation_only: bool, validate: bool
) -> tuple[Tensor, Tensor]:
    if validate:
        check_finite(means=means, covars=covars, weights=weights, transforms=transforms)
    out_means, out_covars = _outputs(means, covars)
    means, weights, transforms = means.contiguous(), weights.contiguous(), transforms.contiguous()
    given = out_covars if covars is None else covars.contiguous()
    if means.device.type == "cpu" and not rotation_only:
        state = torch.zeros(vector_kernels.STATE, dtype=torch.int64)
        words = _input_words(means, None if covars is None else given, weights, transforms, state) | {
            "out_means": place(out_means, 3 * len(means), means.dtype),
            "out_covars": 0 if covars is None else place(out_covars, 9 * len(means), means.dtype),
        }
        run_native(vector_kernels.skin(SCALAR_NAMES[means.dtype]), words, task_count(len(means)))
    else:
        launch_ranges(
            kernels.skin,
            even_cuts(len(means)),
            [*map(view, (means, given, weights, transforms)), int(rotation_only), view(out_means), view(out_covars)],
            like=means,
        )
    return out_means, out_covars


def _gradients(
    means: Tensor,
    covars: Tensor | None,
    weights: Tensor,
    transforms: Tensor,
    rotation_only: bool,
    grad_means: Tensor | None,
    grad_covars: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:
    """An empty tensor for each float input, of no rows where no gradient is wanted."""
    inputs = (means, covars, weights, transforms)
    return [
        means.new_empty((len(tensor) if needed else 0, *tensor.shape[1:])) if tensor is not None else means.new_empty(0)
        for tensor, needed in zip(inputs, needs, strict=True)
    ]


def _skin_backward(
    means: Tensor,
    covars: Tensor | None,
    weights: Tensor,
    transforms: Tensor,
    rotation_only: bool,
    grad_means: Tensor | None,
    grad_covars: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:
    found = _gradients(means, covars, weights, transforms, rotation_only, grad_means, grad_covars, needs)
    by_means, by_covars, by_weights, by_transforms = found
    if grad_covars is None:
        by_covars.zero_()
    needs_means, needs_covars, needs_weights, needs_transforms = needs
    means, weights, transforms = means.contiguous(), weights.contiguous(), transforms.contiguous()
    n, n_joints = len(means), len(transforms)
    by_blends = means.new_empty((n if needs_transforms else 0, 16))
    if means.device.type == "cpu" and not rotation_only:
        dtype = means.dtype
        given = [None if t is None else t.contiguous() for t in (covars, grad_means, grad_covars)]
        state = torch.zeros(vector_kernels.STATE, dtype=torch.int64)
        words = _input_words(means, given[0], weights, transforms, state) | {
            "g_out_means": place(given[1], 3 * n, dtype),
            "g_out_covars": place(given[2], 9 * n, dtype),
            "g_means": place(by_means if needs_means else None, 3 * n, dtype),
            "g_covars": place(by_covars if needs_covars else None, 9 * n, dtype),
            "g_weights": place(by_weights if needs_weights else None, n * n_joints, dtype),
            "g_blends": place(by_blends if needs_transforms else None, 16 * n, dtype),
        }
        run_native(vector_kernels.skin_backward(SCALAR_NAMES[dtype]), words, task_count(n))
    else:
        none = means.new_empty((0, 3, 3))
        launch_ranges(
            kernels.skin_backward,
            even_cuts(n),
            [
                *map(view, (means, none if covars is None else covars.contiguous(), weights, transforms)),
                int(rotation_only),
                view(torch.zeros_like(means) if grad_means is None else grad_means.contiguous()),
                view(none if grad_covars is None else grad_covars.contiguous()),
                *map(view, (by_means, none if covars is None else by_covars, by_weights, by_blends)),
            ],
            like=means,
        )
    if needs_transforms:
        _sum_blends(by_blends, weights, by_transforms)
    return found


def _sum_blends(by_blends: Tensor, weights: Tensor, out: Tensor) -> None:
    """Gradients of transforms from those of blended ones: the sum over points of weight times row."""
    n, n_joints = weights.shape
    if by_blends.device.type == "cpu":
        dtype, n_blocks = by_blends.dtype, -(-n // vector_kernels.BLOCK)
        sums = by_blends.new_empty((n_blocks, n_joints, 16))
        state = torch.zeros(vector_kernels.STATE, dtype=torch.int64)
        words = {
            "n": n,
            "n_joints": n_joints,
            "n_blocks": n_blocks,
            "weights": place(weights, n * n_joints, dtype),
            "g_blends": place(by_blends, 16 * n, dtype),
            "sums": place(sums, n_blocks * n_joints * 16, dtype),
            "g_transforms": place(out, 12 * n_joints, dtype),
            "state": place(state, vector_kernels.STATE, torch.int64),
        }
        run_native(vector_kernels.sum_blends(SCALAR_NAMES[dtype]), words, n_blocks)
    else:
        out.copy_((weights.T @ by_blends).view(n_joints, 4, 4)[:, :, :3].transpose(1, 2))


_operator = operator("skin", _skin, _outputs)
_adjoint = adjoint("skin_backward", _skin_backward, _gradients)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    if inputs[1] is None:
        ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(*inputs[:4])
    ctx.rotation_only = inputs[4]


def _backward(ctx: Any, grad_means: Tensor | None, grad_covars: Tensor | None) -> tuple[Tensor | None, ...]:
    needs = list(ctx.needs_input_grad[:4])
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
    transforms: Float[Tensor, "J 4 4"] | Float[Tensor, "J 3 4"],
    *,
    rotation_only: bool = False,
    validate: bool = True,
) -> Skinned:
    """Points and their covariances, moved by the weighted mean of rigid or affine transforms (linear blend skinning).

    With the blend (G | t) of a point's transforms, its mean becomes G mean + t and its covariance G covariance G^T
    (OASIS, MM '26, eq. 8), with `rotation_only` R covariance R^T, R the rotation nearest to G (the polar factor; proper
    even where G mirrors). Where that rotation is not unique it passes no gradient.

    Differentiable in every float argument.

    Args:
        means: Points at rest [m], shape [N, 3], float32 or float64; N may be 0.
        covars: Covariances at rest [m^2], shape [N, 3, 3]; None for points alone.
        weights: Share of each transform, rows of sum 1, shape [N, J]. Dense: J is meant to be small.
        transforms: Rest to posed, shape [J, 4, 4], the last row taken for 0 0 0 1, or without it, shape [J, 3, 4].
        rotation_only: Turn covariances without stretching them.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.

    Raises:
        ValueError: a wrong shape or dtype, a value that is not finite, or `rotation_only` without covariances.
    """
    sizes: dict[str, int] = {}
    check_shape("means", means, "N", 3, sizes=sizes)
    if covars is not None:
        check_shape("covars", covars, "N", 3, 3, sizes=sizes, hint="One for each mean.")
    elif rotation_only:
        raise ValueError("rotation_only: expected False without covars, got True. It says how covariances turn.")
    check_shape("weights", weights, "N", "J", sizes=sizes, hint="One row for each mean.")
    rows = 3 if transforms.ndim == 3 and transforms.shape[1] == 3 else 4
    check_shape("transforms", transforms, "J", rows, 4, sizes=sizes, hint="One for each column of the weights.")
    check_float("means", means)
    for name, tensor in (("covars", covars), ("weights", weights), ("transforms", transforms)):
        if tensor is not None:
            check_float(name, tensor, means)
    out_means, out_covars = _operator(means, covars, weights, transforms[:, :3], rotation_only, validate)
    return Skinned(out_means, None if covars is None else out_covars)
