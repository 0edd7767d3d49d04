"""A CUDA kernel that is launched again and again with other parameters."""

import ctypes
import struct
from typing import Any

import warp as wp

from oasis_kernels.runtime.cuda_native import CudaNative

MAX_BOUNDS = 256
"""Numbers of blocks of one kernel that a thread remembers."""


class CudaLaunch:
    """A CUDA kernel that is launched with other parameters each time: one packing, and one call of Warp's library."""

    def __init__(self, launch: Any, native: CudaNative) -> None:
        """Take over a launch of one block that Warp has recorded."""
        self._launch, self._threads, self._n_blocks = launch, native.block, 1
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
        self._after = *(ctypes.c_int(int(number)) for number in numbers), launch.params_addr
        self._arguments = *self._before, launch.bounds.size, *self._after

    def __call__(self, n_blocks: int, stream: int, *parameters: int | float) -> None:
        """Launch `n_blocks` blocks, at least one, on the stream of this handle, which a graph may be capturing.

        Args:
            n_blocks: Of `CudaNative.block` threads.
            stream: Of CUDA.
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
