"""The mean absolute difference of float32 images inside a mask on CUDA: `masked_l1.cu`."""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 256
"""Threads of a block."""
CHUNK = 8 * BLOCK
"""Pixels of a block of `sum_differences`."""


def _on_cuda(name: str) -> CudaNative:
    return cuda_native("losses/masked_l1.cu", name, BLOCK, constants={"CHUNK": CHUNK})


sum_differences = _on_cuda("sum_differences")
"""Kernel: one block for every `CHUNK` pixels."""
mean_difference = _on_cuda("mean_difference")
"""Kernel: one block."""
spread_difference = _on_cuda("spread_difference")
"""Kernel: one block for every `BLOCK` pixels."""
