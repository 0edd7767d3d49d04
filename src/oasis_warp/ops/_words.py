"""Parameters of the vectorised CPU kernels of posing."""

import torch
from torch import Tensor

from oasis_kernels.posing_vectors import TASK
from oasis_warp.ops._launch import address


def place(tensor: Tensor | None, size: int, dtype: torch.dtype = torch.float32) -> int:
    """The `address` of a tensor of `size` elements; 0 for none."""
    return 0 if tensor is None else address(tensor, dtype, size)


def task_count(*items: int) -> int:
    """Of a kernel with phases over so many items."""
    return -(-max(items) // TASK)
