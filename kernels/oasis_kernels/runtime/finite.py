"""Whether numbers are finite and of a sensible size: one pass on the CPU, one launch on CUDA, for several arrays.

On the CPU torch's own reductions start its pool of threads for arrays of this size, which goes on spinning for a while
on the cores that our threads want.
"""

import functools

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import Native, native

BLOCK = 256
CHUNK = 16 * BLOCK
"""Numbers that a block on CUDA reads."""
ARRAYS = 10
"""Arrays that fit into one launch on CUDA."""

ALL_FINITE: Native = native("runtime/finite.cpp", "all_finite")
"""CPU kernel: `count` pairs of an address and a length of float32 -> 1 in `found` if a number is not within 1e15."""


@functools.cache
def cuda_all_finite() -> CudaNative:
    """CUDA kernel: `ARRAYS` arrays of floats, or of doubles where `wide`, -> 1 in `found` if one is beyond `largest`.

    It takes the chunks of all arrays together as blocks; arrays that are not needed have count 0.
    """
    constants = {"ARRAYS": ARRAYS, "CHUNK": CHUNK}
    return cuda_native("runtime/finite.cu", "all_finite", BLOCK, label="all_finite_cuda", constants=constants)
