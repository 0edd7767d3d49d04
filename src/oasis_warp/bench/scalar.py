"""The generic kernels in float32 on the CPU, where the operators choose vectorised ones: what the vectors gain.

No option of the operators, for nobody but a benchmark wants it: inside `generic_kernels` the questions "is there a
vectorised kernel for this tensor" are answered with no, and depth buffers are filled as on CUDA.
"""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

from torch import Tensor

from oasis_warp.ops import _depth_buffer

QUESTIONS = ("is_vectorised", "has_vectors", "draws_strips")
"""Functions of `oasis_warp.ops` from a tensor to whether it has a vectorised kernel."""


@contextmanager
def generic_kernels() -> Iterator[None]:
    """Have the operators use their generic kernels inside the block, for float32 on the CPU too."""

    def no(tensor: Tensor) -> bool:
        return False

    modules = [module for name, module in sys.modules.items() if name.startswith("oasis_warp.ops.")]
    with ExitStack() as patched:
        for question in QUESTIONS:
            askers = [module for module in modules if hasattr(module, question)]
            assert askers, f"no operator asks {question} any more"
            for module in askers:
                patched.enter_context(patch.object(module, question, no))
        patched.enter_context(patch.object(_depth_buffer, "draw_by_vectors", _depth_buffer.draw_by_faces))
        yield
