"""Checks for finite values that are fast enough to be part of every call of an operator."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from oasis_kernels.runtime import finite
from oasis_warp.ops import checks
from oasis_warp.ops._runtime.launch import cuda_launch, current_stream, has_vectors, run_native
from oasis_warp.ops._runtime.pair_counts import slots


def check_finite(**tensors: Tensor | None) -> None:
    """Refuse NaN, infinities and absurd magnitudes.

    Raises:
        ValueError: names the argument and how many of its values are bad.
    """
    given = {name: tensor.detach() for name, tensor in tensors.items() if tensor is not None}
    if given and all(t.is_cuda for t in given.values()):
        with DeferredFiniteCheck(**given):
            return
    quick = [t for t in given.values() if has_vectors(t) and t.is_contiguous()]
    if quick:
        arrays = torch.tensor([(t.data_ptr(), t.numel()) for t in quick])
        found = torch.zeros(1, dtype=torch.int64)
        run_native(finite.ALL_FINITE, {"arrays": arrays, "count": len(quick), "found": found}, n_tasks=1)
        if not found[0]:
            given = {name: t for name, t in given.items() if not any(t is known for known in quick)}
    checks.check_finite(**given)  # also for the message, if something was found


def refuse_capture() -> None:
    """Refuse to check values while a CUDA graph captures the call: they do not exist yet."""
    if torch.cuda.is_current_stream_capturing():
        raise ValueError(
            "validate: expected False while a CUDA graph is being captured, got True. Values exist only once it runs."
        )


class DeferredFiniteCheck:
    """`check_finite` of CUDA tensors that runs on the device while the host runs the `with` block.

    The end of the block waits for the device and raises what `check_finite` raises.
    """

    def __init__(self, **tensors: Tensor | None) -> None:
        self._given = {name: tensor.contiguous() for name, tensor in tensors.items() if tensor is not None}

    def __enter__(self) -> None:
        refuse_capture()
        tensors = list(self._given.values())
        self._device = tensors[0].device
        self._slot = slots.take()
        address = self._slot.data_ptr()
        self._found = ctypes.c_longlong.from_address(address)
        self._found.value = 0
        _launch_check(tensors, address)

    def __exit__(self, kind: Any, *_: Any) -> None:
        torch.cuda.current_stream(self._device).synchronize()  # even after an error: the kernel writes to the slot
        bad = self._found.value
        slots.release(self._slot)
        if bad and kind is None:
            checks.check_finite(**self._given)
            raise AssertionError("the kernel has met a bad value that is not in its inputs")


class ReplayedFiniteCheck:
    """Check for finite values of a CUDA tensor that is captured in a graph and runs with every replay."""

    def __init__(self, tensor: Tensor) -> None:
        """Nothing is checked yet; `tensor` is contiguous."""
        self._tensor = tensor
        self._slot = slots.take()  # stays the graph's: it may be replayed after this is gone
        self._found = ctypes.c_longlong.from_address(self._slot.data_ptr())

    def check(self) -> None:
        """Record the check into the graph that is being captured."""
        _launch_check([self._tensor], self._slot.data_ptr())

    def reset(self) -> None:
        """Clear the result of the last check."""
        self._found.value = 0

    def bad(self) -> bool:
        """Whether the last finished check found a bad value."""
        return self._found.value != 0


def _launch_check(tensors: list[Tensor], address: int) -> None:
    """Write 1 to `address`, host memory, if a number is bad."""
    stream = current_stream(tensors[0].device)
    launch = cuda_launch(finite.cuda_all_finite(), stream.device)
    for first in range(0, len(tensors), finite.ARRAYS):
        some = tensors[first : first + finite.ARRAYS]
        counts = [t.numel() for t in some]
        n_blocks = sum(-(-count // finite.CHUNK) for count in counts)
        if n_blocks:
            others = (0,) * (finite.ARRAYS - len(some))
            launch(
                n_blocks, stream.cuda_stream, address, checks.FINITE_LIMIT, *[t.data_ptr() for t in some], *others,
                *counts, *others, *[t.dtype is torch.float64 for t in some], *others,
            )  # fmt: skip
