"""CUDA kernels: C++ functions that take raw pointers, and numbers by value.

Such a kernel has one argument, a block of 64-bit words: pointers, whole numbers, or doubles, in the order of the C++
parameters; an array `T name[n]` of pointers or long longs is n words. Setting them costs the host a microsecond or two,
where an array object for each argument costs several for each, and a launch that was recorded once is replayed with
another block.
"""

import ctypes
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import warp as wp

from oasis_kernels.runtime.native import _typed, defined, kernel_source

READS = {"float": "(float)__longlong_as_double(parameters[{}])", "double": "__longlong_as_double(parameters[{}])"}


@dataclass(frozen=True)
class CudaNative:
    """A C++ function as a kernel."""

    kernel: Any
    block_type: Any
    """A ctypes structure of its parameters."""
    parameters: tuple[str, ...]
    """Their names, in order."""
    block: int
    """Threads of a block."""


def cuda_native(
    path: str,
    name: str,
    block: int,
    *,
    blocks_per_multiprocessor: int = 1,
    label: str | None = None,
    constants: Mapping[str, object] | None = None,
    scalar: str = "float",
    fuse: bool = True,
) -> CudaNative:
    """Build the kernel `name` of the C++ file `path`.

    The function sees, besides its parameters, `block_index` (int), the number of its block; threads of a block are told
    apart by threadIdx.x. It runs for all threads of every block.

    Args:
        path: Relative to the package.
        name: Name of the function.
        block: Threads of a block: a power of two.
        blocks_per_multiprocessor: Number of blocks that shall fit at once: limits the registers of a thread.
        label: Name of the kernel as profilers show it; `name` if None.
        constants: Macros that the function sees, besides `BLOCK` and `WARPS`, the threads and warps of a block.
        scalar: "float" or "double": what `T` stands for in the parameters.
        fuse: Whether multiply-adds are fused.
    """
    source = kernel_source(path, name)
    declared = _typed(source.parameters, scalar)
    constants = {"BLOCK": block, "WARPS": block // 32, **(constants or {})}
    lines, fields, size = [], [], 0
    for p, kind in declared.items():
        field: Any = ctypes.c_double if kind in READS else ctypes.c_longlong
        if kind.endswith("]"):
            kind, length = kind[:-1].split("[")
            lines.append(f"{kind} const* const {p} = ({kind} const*)&parameters.c[{size}];")
            field = field * int(str(constants.get(length, length)))
        else:
            lines.append(f"{kind} const {p} = {READS.get(kind, f'({kind})parameters[{{}}]').format(size)};")
        fields.append((p, field))
        size += ctypes.sizeof(field) // 8
    body = defined(constants, source.body)
    if not fuse:  # never compiled for the CPU, where such a module has no such option
        body = f"#if defined(__CUDA_ARCH__)\n{body}#endif\n"
    text = "\n    ".join([f"const int block_index = thread / {block};", *lines]) + "\n" + body
    vector = wp.types.vector(length=size, dtype=wp.int64)

    def snippet(thread: int, parameters: Any): ...

    # Warp keeps functions by name, and a second one of a name takes the place of the first.
    label = label or name
    snippet.__qualname__ = f"{label}_{hashlib.sha1(text.encode()).hexdigest()[:16]}"
    snippet.__annotations__["parameters"] = vector
    run = wp.func_native(text)(snippet)

    def launch(parameters: Any):
        run(wp.tid(), parameters)

    launch.__annotations__["parameters"] = vector
    launch.__name__ = launch.__qualname__ = label
    kernel: Any = wp.kernel(
        launch, enable_backward=False, module="unique", launch_bounds=(block, blocks_per_multiprocessor)
    )
    if not fuse:
        wp.set_module_options({"fuse_fp": False}, module=kernel.module)
    block_type = type(f"{label}_parameters", (ctypes.Structure,), {"_fields_": fields})
    return CudaNative(kernel, block_type, tuple(declared), block)
