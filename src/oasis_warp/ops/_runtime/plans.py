"""Planned calls on CUDA: kernels launched again with other parameters, cache of plans, workspace layout, gradients."""

import ctypes
import struct
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import Function
from torch.nn import Parameter

from oasis_kernels.runtime.cuda_native import CudaNative

MAX_BOUNDS = 256
"""Numbers of blocks of one kernel that a thread remembers."""
MAX_PLANS = 32
"""Kinds of calls that a thread remembers."""
ALIGNMENT = 256
"""Alignment of the arrays in a workspace [bytes]."""


class Slot(NamedTuple):
    """A parameter whose value only a call knows: an entry in the C++ node's list of values, and what is added."""

    place: int
    """-1: the value alone."""
    value: int


class CudaLaunch:
    """A CUDA kernel that is launched with other parameters each time: one packing, and one call of Warp's library."""

    def __init__(self, launch: Any, native: CudaNative) -> None:
        """Take over a launch of one block that Warp has recorded."""
        self._launch, self._native, self._threads, self._n_blocks = launch, native, native.block, 1
        self._bounds: dict[int, Any] = {1: launch.bounds}  # by number of blocks; Warp reads them where they lie
        size = ctypes.sizeof(native.block_type) // ctypes.sizeof(ctypes.c_longlong)
        kinds = [kind for _, kind in native.block_type._fields_]
        code = "".join("d" if kind is ctypes.c_double else "q" * (ctypes.sizeof(kind) // 8) for kind in kinds)
        self._pack = struct.Struct("=" + code).pack_into
        self._packed = (ctypes.c_longlong * size)()
        launch.params_addr[1] = ctypes.c_void_p(ctypes.addressof(self._packed))
        self._call = wp._src.context.runtime.core.wp_cuda_launch_kernel
        # As ctypes' own numbers, which it passes on as they are.
        self._before = ctypes.c_void_p(launch.device.context), ctypes.c_void_p(launch.hooks.forward)
        numbers = (
            launch.max_blocks, launch.block_dim, launch.grid_stride, launch.cluster_dim,
            launch.hooks.forward_smem_bytes,
        )  # fmt: skip
        self._numbers = [int(number) for number in numbers]
        self._after = *map(ctypes.c_int, self._numbers), launch.params_addr
        self._arguments = *self._before, launch.bounds.size, *self._after

    def __call__(self, n_blocks: int, stream: int, *parameters: int | float) -> None:
        """Launch `n_blocks` blocks, at least one, on the stream of this handle, which a graph may be capturing.

        Args:
            n_blocks: Number of blocks of `CudaNative.block` threads.
            stream: CUDA stream.
            *parameters: In the order of the kernel: addresses and numbers, an array as its elements.

        Raises:
            RuntimeError: CUDA refuses the launch.
        """
        if n_blocks != self._n_blocks:
            self._resize(n_blocks)
        self._pack(self._packed, 0, *parameters)
        if self._call(*self._arguments, stream, None):
            raise RuntimeError(f"{self._launch.kernel.key}: {wp._src.context.runtime.get_error_string()}")

    def _resize(self, n_blocks: int) -> None:
        bounds = self._bounds.get(n_blocks)
        if bounds is None:
            if len(self._bounds) >= MAX_BOUNDS:
                self._bounds.clear()
            self._launch.set_dim(n_blocks * self._threads)
            bounds = self._bounds[n_blocks] = self._launch.bounds
        self._launch.params_addr[0] = ctypes.c_void_p(ctypes.addressof(bounds))
        self._n_blocks = n_blocks
        self._arguments = *self._before, bounds.size, *self._after

    def described(self, n_blocks: int, values: Mapping[str, Slot | int | float]) -> tuple[Any, ...]:
        """What `Launch` of the C++ node is made of, for `n_blocks` blocks and parameters by name."""
        self._resize(n_blocks)
        words = []
        for name, kind in self._native.block_type._fields_:
            value = values[name]
            if not isinstance(value, Slot):
                value = Slot(-1, struct.unpack("=q", struct.pack("=d" if kind is ctypes.c_double else "=q", value))[0])
            words.append(value)
        bounds = self._bounds[n_blocks]
        handles = (handle.value or 0 for handle in self._before)
        return self._native.kernel.key, *handles, bytes(bounds), bounds.size, self._numbers, words


class Plans(threading.local):
    """Thread-local plans by kind of call; the oldest is dropped."""

    def __init__(self) -> None:
        self.plans: dict[tuple[Any, ...], Any] = {}

    def keep(self, key: tuple[Any, ...], plan: Any) -> Any:
        """Remember `plan`, and return it."""
        while len(self.plans) >= MAX_PLANS:
            del self.plans[next(iter(self.plans))]
        self.plans[key] = plan
        return plan


def shapes_of(tensors: Iterable[Tensor | None], device: int) -> list[Any] | None:
    """Shapes of plain float32 tensors on a CUDA device; None where one is of another kind."""
    shapes: list[Any] = []
    for tensor in tensors:
        if tensor is None:
            shapes.append(None)
            continue
        kind = type(tensor)
        if (
            (kind is not Tensor and kind is not Parameter)
            or tensor.dtype is not torch.float32
            or tensor.get_device() != device
            or tensor.layout is not torch.strided
            or tensor.is_neg()
        ):
            return None
        shapes.append(tensor.shape)
    return shapes


def lay_out(sizes: Mapping[str, int], start: int = 0) -> tuple[dict[str, int], int]:
    """Places of arrays of these `sizes` after `start`, and where they end [bytes]."""
    places, end = {}, start
    for name, size in sizes.items():
        places[name], end = end, end + -(-size // ALIGNMENT) * ALIGNMENT
    return places, end


def addresses(tensors: Iterable[Tensor | None]) -> list[int]:
    """Addresses of memory on the device; 0 for None."""
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


class _DifferentiableOnce(Function):
    """Gradients that have no derivative."""

    @staticmethod
    def forward(ctx: Any, caller: str, count: int, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.caller = caller
        return tuple(None if tensor is None else tensor.view_as(tensor) for tensor in tensors[count:])

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise RuntimeError(
            f"{ctx.caller}: expected one derivative, got a request for the second. "
            "It is differentiable once; detach the gradient before you go on with it."
        )


def differentiable_once(caller: str, inputs: Sequence[Tensor | None], gradients: Sequence[Tensor | None]) -> Any:
    """`gradients`, which raise if autograd wants to go through them (create_graph=True)."""
    return _DifferentiableOnce.apply(caller, len(inputs), *inputs, *gradients) if torch.is_grad_enabled() else gradients
