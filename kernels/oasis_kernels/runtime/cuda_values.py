"""Whether numbers on a CUDA device are finite and of a sensible size: one launch for several arrays.

A block looks at `CHUNK` numbers of one array; what is wrong is one word in memory of the host, for whoever waits for
the device to read.
"""

import functools

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 256
CHUNK = 16 * BLOCK
"""Numbers a block looks at."""
ARRAYS = 10
"""That fit into one launch."""

FIND = """
    const void* data = nullptr;
    long long count = 0, first = 0, chunk = block_index;
    int wide = 0;
"""
SELECT = """
    if (chunk >= 0) {
        const long long chunks = (count@ + CHUNK - 1) / CHUNK;
        if (chunk < chunks) { data = data@; count = count@; wide = wide@; first = chunk * CHUNK; }
        chunk -= chunks;
    }
"""
LOOK = """
    const long long end = first + CHUNK < count ? first + CHUNK : count;
    bool bad = false;
    if (wide) {
        const double* const values = (const double*)data;
        for (long long i = first + threadIdx.x; i < end; i += BLOCK)
            bad |= !(values[i] >= -largest && values[i] <= largest);  // true for NaN too
    } else {
        const float* const values = (const float*)data;
        for (long long i = first + threadIdx.x; i < end; i += BLOCK)
            bad |= !(values[i] >= -(float)largest && values[i] <= (float)largest);
    }
    if (bad) *found = 1;
"""


@functools.cache
def all_finite() -> CudaNative:
    """Kernel: `ARRAYS` arrays of floats, or of doubles where `wide`, -> 1 in `found` if a number is beyond `largest`.

    It takes the chunks of all arrays together as blocks; arrays that are not needed have count 0.
    """
    body = FIND + "".join(SELECT.replace("@", str(k)) for k in range(ARRAYS)) + LOOK
    body = body.replace("CHUNK", str(CHUNK)).replace("BLOCK", str(BLOCK))
    arrays = {
        f"{word}{k}": kind
        for k in range(ARRAYS)
        for word, kind in (("data", "const void*"), ("count", "long long"), ("wide", "int"))
    }
    return cuda_native("all_finite_cuda", {"found": "volatile long long*", "largest": "double", **arrays}, body, BLOCK)
