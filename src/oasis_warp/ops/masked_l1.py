"""The mean absolute difference of two images inside a mask by three kernels, where torch launches a dozen."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import Function

from oasis_kernels.losses import masked_l1 as kernels
from oasis_kernels.runtime.cuda_native import CudaNative
from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime.launch import block_count, cuda_launch, current_stream
from oasis_warp.ops._runtime.plans import differentiable_once, shapes_of
from oasis_warp.ops._runtime.transforms import in_forward_mode


def masked_l1_on_cuda(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Float[Tensor, ""] | None:
    """Sum of mask |image - target| / (3 max(sum of mask, 1)), differentiable once, in `image`.

    The same bits every time; sums are float64 inside.

    Args:
        image: Float32 on a CUDA device.
        target: Without a gradient, as the mask.
        mask: Weight of each pixel, not negative.

    Returns:
        None for what the kernels do not take: other types, devices, strides or sizes, or tensors that are traced.
    """
    given = image, target, mask
    if not image.is_cuda or is_traced() or in_forward_mode():
        return None
    shapes = shapes_of(given, image.get_device())
    if shapes is None or not (shapes[0] == shapes[1] == (*shapes[2], 3)) or not all(t.is_contiguous() for t in given):
        return None
    tracks = torch.is_grad_enabled()
    if not mask.numel() or (tracks and (target.requires_grad or mask.requires_grad)):
        return None
    return _masked_l1(*given) if tracks and image.requires_grad else _mean(*given)[0]


def _launch(native: CudaNative, n_blocks: int, like: Tensor, *values: int) -> None:
    stream = current_stream(like.device)
    cuda_launch(native, stream.device)(n_blocks, stream.cuda_stream, *values)


def _mean(image: Tensor, target: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """The mean, and sums whose last number is what it was divided by, inverted."""
    n = mask.numel()
    blocks = block_count(n, kernels.CHUNK)
    sums, mean = image.new_empty(2 * blocks + 1, dtype=torch.float64), image.new_empty(())
    addresses = image.data_ptr(), target.data_ptr(), mask.data_ptr()
    _launch(kernels.sum_differences, blocks, image, n, *addresses, sums.data_ptr())
    _launch(kernels.mean_difference, 1, image, blocks, sums.data_ptr(), mean.data_ptr())
    return mean, sums


class _MaskedL1(Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
        mean, ctx.sums = _mean(image, target, mask)
        ctx.save_for_backward(image, target, mask)
        return mean

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        image, target, mask = given = ctx.saved_tensors
        by_image = torch.empty_like(image)
        n, share = mask.numel(), ctx.sums.data_ptr() + 8 * (len(ctx.sums) - 1)
        _launch(
            kernels.spread_difference, block_count(n, kernels.BLOCK), image, n, image.data_ptr(), target.data_ptr(),
            mask.data_ptr(), share, gradient.data_ptr(), by_image.data_ptr(),
        )  # fmt: skip
        return differentiable_once("masked_l1", given, (by_image, None, None))


# Below Function.apply, which takes 3 us to look for functorch: `is_traced` has.
_masked_l1: Callable[..., Tensor] = super(Function, _MaskedL1).apply  # pyright: ignore[reportAttributeAccessIssue]
