"""How the vectorised CPU kernels are compiled: C++ snippets with wide vectors that Clang lowers to what the CPU has."""

import os
import platform
from typing import Any


def cpu_options() -> dict[str, Any]:
    """Options of a Warp module with wide vectors: the flags in $OASIS_WARP_CPU_FLAGS, else those of this CPU.

    Clang prefers 256-bit registers even where 512-bit ones exist, unless told. Another value serves to build for, or
    to try, other machines: "-target-cpu x86-64-v3" has 256-bit vectors, "-target-cpu x86-64-v2" 128-bit ones.
    """
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    native = "-march=native -mprefer-vector-width=512" if x86 else "-march=native"
    return {"enable_backward": False, "cpu_compiler_flags": os.environ.get("OASIS_WARP_CPU_FLAGS", native)}
