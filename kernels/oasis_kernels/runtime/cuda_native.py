"""CUDA kernels written as one C++ snippet each, that take raw pointers and numbers by value.

Such a kernel has one argument, a block of 64-bit words: pointers, whole numbers, or doubles, in the order in which the
kernel names them. Setting them costs the host a microsecond or two, where an array object an argument costs several
each, and a launch that was recorded once is replayed with other words.
"""

import ctypes
import hashlib
from dataclasses import dataclass
from typing import Any

import warp as wp


@dataclass(frozen=True)
class CudaNative:
    """A snippet as a kernel."""

    kernel: Any
    words: Any
    """A ctypes structure of its parameters."""
    parameters: tuple[str, ...]
    """Their names, in order."""
    block: int
    """Threads a block."""


def cuda_native(
    name: str, parameters: dict[str, str], body: str, block: int, blocks_a_multiprocessor: int = 1
) -> CudaNative:
    """Build the kernel `name` from the C++ `body`.

    The body sees each of `parameters` (name: C++ type) as a constant, and `block_index` (int), the number of its block;
    threads of a block are told apart by threadIdx.x. It runs for all threads of every block.

    Args:
        name: Of the kernel, as profilers show it.
        parameters: Pointers, whole numbers, and "float" or "double".
        body: C++.
        block: Threads a block: a power of two.
        blocks_a_multiprocessor: That many shall fit at once: limits the registers of a thread.
    """
    reads = {"float": "(float)__longlong_as_double(words[{}])", "double": "__longlong_as_double(words[{}])"}
    lines = [f"{kind} const {p} = {reads.get(kind, f'({kind})words[{{}}]').format(k)};"
             for k, (p, kind) in enumerate(parameters.items())]  # fmt: skip
    text = "\n    ".join([f"const int block_index = thread / {block};", *lines]) + "\n" + body
    vector = wp.types.vector(length=len(parameters), dtype=wp.int64)

    def snippet(thread: int, words: Any): ...

    # Warp keeps functions by name, and a second one of a name takes the place of the first.
    snippet.__qualname__ = f"{name}_{hashlib.sha1(text.encode()).hexdigest()[:16]}"
    snippet.__annotations__["words"] = vector
    run = wp.func_native(text)(snippet)

    def launch(words: Any):
        run(wp.tid(), words)

    launch.__annotations__["words"] = vector
    launch.__name__ = launch.__qualname__ = name
    kernel = wp.kernel(
        launch, enable_backward=False, module="unique", launch_bounds=(block, blocks_a_multiprocessor)
    )
    fields = [(p, ctypes.c_double if kind in reads else ctypes.c_longlong) for p, kind in parameters.items()]
    words = type(f"{name}_words", (ctypes.Structure,), {"_fields_": fields})
    return CudaNative(kernel, words, tuple(parameters), block)
