"""Float32 skinning: `skinning.cpp` on the CPU, in float64 too, and `skinning.cu` on CUDA. See `skinning`."""

import functools

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

STATE = 2 * PHASE_WORDS
"""Words of zeros that threads on the CPU share."""
SUM_BLOCK = 256
"""Points whose gradients of transforms `sum_blends` adds up at a time."""
BLOCK = 128
"""Threads of a block on CUDA."""
POINTS = BLOCK // 4
"""Points of a block of `cuda_skin`."""
POSES = 8
"""Poses that a block of `cuda_skin` works on, one after the other: its points and correctives stay in the cache."""


@functools.cache
def on_cpu(name: str, scalar: str) -> Native:
    """CPU kernel "skin", "skin_backward" or "sum_blends" in "float" or "double".

    The last gives the gradients of the transforms from those of the blended ones.
    """
    constants = {"SCALAR": scalar, "BLOCK": SUM_BLOCK}
    return native("skinning/skinning.cpp", name, label=f"{name}_{scalar}", scalar=scalar, constants=constants)


def _on_cuda(name: str) -> CudaNative:
    return cuda_native("skinning/skinning.cu", name, BLOCK, constants={"POINTS": POINTS, "POSES": POSES})


cuda_skin = _on_cuda("skin")
"""Kernel: for every `POSES` poses, one block for every `POINTS` points. At multiples of 16 bytes: weights, transforms;
of 8 bytes: displacements."""
cuda_skin_backward = _on_cuda("skin_backward")
"""Kernel: for each pose, one block for every `BLOCK` points."""
cuda_sum_blocks = _on_cuda("sum_blocks")
"""Kernel: for each pose, one block for every `BLOCK` of the 12 J entries, which are sums over `n_sums` blocks."""
