"""Run a vectorised CPU kernel whose arguments stand in one block of 64-bit numbers.

A typed launch costs some 20 us and 10 more for each array it is given; these kernels take tenths of a millisecond.
"""

import ctypes
import os
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
import warp as wp
from torch import Tensor

from oasis_warp.ops import _launch

_idle: defaultdict[Any, list[Any]] = defaultdict(list)
"""Recorded launches of each kernel that nobody uses just now: threads must not share one, for it holds arguments."""


def is_vectorised(tensor: Tensor) -> bool:
    """Whether float kernels for `tensor` have a vectorised form: float32 on the CPU."""
    return tensor.dtype == torch.float32 and tensor.device.type == "cpu"


def run_tasks(kernel: Any, n_tasks: int, arguments: Sequence[Tensor | int | None], least: int = 4096) -> None:
    """Do all tasks of `kernel` (as `posing_vectors.kernel` makes them), shared out over torch's number of threads.

    Args:
        kernel: Writes for each task only what is that task's own; then results do not depend on the shares.
        n_tasks: How many; none is no launch.
        arguments: Of the block, in order. Tensors contiguous, on the CPU, alive until this returns, and as large as
            the kernel takes for granted; None is the address 0.
        least: Tasks that are worth a thread of their own.
    """
    if n_tasks == 0:
        return
    values = [
        0 if value is None else value.data_ptr() if isinstance(value, Tensor) else value for value in arguments
    ]
    block = (ctypes.c_int64 * len(values))(*values)
    address = ctypes.addressof(block)

    def run(bounds: tuple[int, int]) -> None:
        recorded = _idle[kernel]
        try:
            command = recorded.pop()  # atomic, as is append
        except IndexError:
            command = _record(kernel)
        for index, value in enumerate((address, *bounds)):
            command.set_param_at_index_from_ctype(index, value)
        command.launch()
        recorded.append(command)

    cuts = _launch.even_cuts(n_tasks, least)
    if len(cuts) == 2:
        run((0, n_tasks))
        return
    list(_launch._pool(os.getpid(), len(cuts) - 1).map(run, pairwise(cuts)))


def _record(kernel: Any) -> Any:
    _launch.start()
    with _launch._load_lock:  # threads that meet at an unbuilt kernel would each build it
        kernel.module.load(wp.get_device("cpu"), 1)
    return wp.launch(kernel, dim=1, inputs=[0, 0, 0], device="cpu", record_cmd=True)
