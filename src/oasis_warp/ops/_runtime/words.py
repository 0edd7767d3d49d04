"""Parameters of the kernels of posing that take raw pointers: the vectorised ones of the CPU and those of CUDA."""

import torch
from torch import Tensor

from oasis_kernels.runtime.native import TASK
from oasis_warp.ops._runtime.launch import address


def place(tensor: Tensor | None, size: int, dtype: torch.dtype = torch.float32) -> int:
    """The `address` of a tensor of `size` elements; 0 for none."""
    return 0 if tensor is None else address(tensor, dtype, size)


def task_count(*items: int) -> int:
    """Of a kernel with phases over so many items."""
    return -(-max(items) // TASK)


def pointer(tensor: Tensor | None) -> int:
    """Where the data of a contiguous tensor begin; 0 for none, and for an empty one."""
    return 0 if tensor is None else tensor.data_ptr()


def aligned(tensor: Tensor | None) -> Tensor | None:
    """The same numbers, contiguous, at a multiple of 16 bytes: rows of four are read as one."""
    if tensor is None:
        return None
    tensor = tensor.contiguous()
    return tensor.clone() if tensor.data_ptr() % 16 else tensor
