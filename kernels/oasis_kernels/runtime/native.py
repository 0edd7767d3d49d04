"""CPU kernels: C++ functions that take raw pointers and share their work among threads themselves.

The one argument of such a kernel is the address of its parameter block: 64-bit words, pointers or whole numbers, in the
order of the C++ parameters. A launch is one call of the function; several threads may launch the same kernel with the
same block at once, to work on it together: the function deals out numbered tasks with `phase` (see `phase.h`).
"""

import hashlib
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import warp as wp

from oasis_kernels.runtime.source import defined, header_source, kernel_source

PHASE_WORDS = 16
"""Words of zeros that the threads in a phase share."""
TASK = 1024
"""Items that a thread takes at a time in `ranges.h`."""


@dataclass(frozen=True)
class Native:
    """A C++ function as a kernel, and the names of its parameters, in order."""

    kernel: Any
    parameters: tuple[str, ...]
    """The first is `give_way`: the address of a function without arguments that lets other threads run, or 0."""


def cpu_options() -> dict[str, Any]:
    """Options of a Warp module with wide vectors: the flags in $OASIS_WARP_CPU_FLAGS, else those of this CPU.

    Clang prefers 256-bit registers, even where 512-bit ones exist, without a flag. Another value serves to build for,
    or to try, other machines: "-target-cpu x86-64-v3" has 256-bit vectors, "-target-cpu x86-64-v2" 128-bit ones.
    """
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    native = "-march=native -mprefer-vector-width=512" if x86 else "-march=native"
    return {"enable_backward": False, "cpu_compiler_flags": os.environ.get("OASIS_WARP_CPU_FLAGS", native)}


def native(
    path: str,
    name: str,
    *,
    label: str | None = None,
    constants: Mapping[str, object] | None = None,
    scalar: str = "float",
    shared: Mapping[str, str] | None = None,
) -> Native:
    """Build the kernel `name` of the C++ file `path`.

    Args:
        path: Relative to the package.
        name: Of the function.
        label: Name of the kernel as profilers show it; `name` if None.
        constants: Macros that the function sees, besides `PHASE_WORDS` and `TASK`.
        scalar: "float" or "double": what `T` stands for in the parameters.
        shared: Parameters before those of the function: C++ types by name.
    """
    source = kernel_source(path, name)
    parameters = {"give_way": "long long", **(shared or {}), **_typed(source.parameters, scalar)}
    lines = [f"{kind} const {p} = ({kind})words[{k}];" for k, (p, kind) in enumerate(parameters.items())]
    body = source.body
    if body.lstrip().startswith("#pragma"):  # which has to stand at the start of a block
        body = "{\n" + body + "}\n"
    body = defined({"PHASE_WORDS": PHASE_WORDS, "TASK": TASK, **(constants or {})}, body)
    lines = ["const long long* words = (const long long*)block;", *lines]
    text = "\n    ".join(lines) + "\n" + header_source("runtime/phase.h") + body

    def snippet(block: wp.uint64): ...

    # Warp keeps functions by name, and a second one of a name takes the place of the first.
    label = label or name
    snippet.__qualname__ = f"{label}_{hashlib.sha1(text.encode()).hexdigest()[:16]}"
    run = wp.func_native(text)(snippet)

    def launch(block: wp.uint64):
        run(block)

    launch.__name__ = launch.__qualname__ = label
    return Native(wp.kernel(launch, module="unique", module_options=cpu_options()), tuple(parameters))


def _typed(parameters: Mapping[str, str], scalar: str) -> dict[str, str]:
    """`parameters` with T* as pointers to `scalar`."""
    return {name: kind.replace("T*", f"{scalar}*") for name, kind in parameters.items()}
