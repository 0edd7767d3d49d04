"""The generic kernels in float32 on the CPU, where the operators choose vectorised ones: what the vectors gain.

No option of the operators, for nobody but a benchmark wants it: inside `generic_kernels` the question "is there a
vectorised kernel for this tensor" is answered with no, and depth buffers are filled as on CUDA.
"""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

from torch import Tensor

from oasis_warp.ops._runtime import depth_buffer


@contextmanager
def generic_kernels() -> Iterator[None]:
    """Have the operators use their generic kernels inside the block, for float32 on the CPU too."""

    def no(tensor: Tensor) -> bool:
        return False

    modules = [module for name, module in sys.modules.items() if name.startswith("oasis_warp.ops.")]
    with ExitStack() as patched:
        for module in modules:
            if hasattr(module, "has_vectors"):
                patched.enter_context(patch.object(module, "has_vectors", no))
        patched.enter_context(patch.object(depth_buffer, "draw_by_vectors", depth_buffer.draw_by_faces))
        yield
