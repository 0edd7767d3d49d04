"""Many poses of one mesh at once, for kernels that know only one: one pose after the other."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def pose_by_pose(
    outputs: Sequence[Tensor], n_poses: int, one: Callable[[int], Sequence[Tensor]], shared: Sequence[bool] = ()
) -> None:
    """Fill in `outputs` with what `one`(pose) returns.

    Args:
        outputs: One for each of what `one` returns: with an axis of poses in front, or, where `shared`, the sum over
            the poses, in their order.
        n_poses: How many there are.
        one: The results of one pose.
        shared: Whether an output is a sum, for each; none is if nothing is given.
    """
    shared = shared or [False] * len(outputs)
    for output, summed in zip(outputs, shared, strict=True):
        if summed:
            output.zero_()
    for k in range(n_poses):
        for output, summed, result in zip(outputs, shared, one(k), strict=True):
            if summed:
                output += result
            elif output.numel():
                output[k] = result


def at_pose(tensor: Tensor | None, k: int) -> Tensor | None:
    """A tensor's share of pose `k`."""
    return None if tensor is None else tensor[k]


def summed_over_poses(tensor: Tensor, batched: bool) -> Tensor:
    """The gradient of what all poses share."""
    return torch.sum(tensor, 0) if batched else tensor
