"""C++ kernels: their text, and functions for the CPU that take raw pointers and share their work among threads.

A kernel is a function at the left margin of a `.cpp` or `.cu` file of this package, read as text and compiled by Warp.
Its parameters become those of the launch, its body the text of a Warp snippet, both with the files that they include
put in their places. Headers (`.h`) hold what the bodies of several kernels share; they are included inside of
functions, so that their lambdas see the parameters. Parameters that several kernels share stand in lists of their own
(`.inc`).

The one argument of a CPU kernel is the address of its parameter block: 64-bit words, pointers or whole numbers, in the
order of the C++ parameters. A launch is one call of the function; several threads may launch the same kernel with the
same block at once, to work on it together: the function deals out numbered tasks with `phase` (see `phase.h`).
"""

import functools
import hashlib
import os
import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import warp as wp

PHASE_WORDS = 16
"""Words of zeros that the threads in a phase share."""
TASK = 1024
"""Items that a thread takes at a time in `ranges.h`."""


@dataclass(frozen=True)
class Native:
    """A C++ function as a kernel, and the names of its parameters, in order."""

    kernel: Any
    parameters: tuple[str, ...]
    """The first is `yield_thread`: the address of a function without arguments that lets other threads run, or 0."""


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
        name: Name of the function.
        label: Name of the kernel as profilers show it; `name` if None.
        constants: Macros that the function sees, besides `PHASE_WORDS` and `TASK`.
        scalar: "float" or "double": what `T` stands for in the parameters.
        shared: Parameters before those of the function: C++ types by name.
    """
    source = kernel_source(path, name)
    parameters = {"yield_thread": "long long", **(shared or {}), **_typed(source.parameters, scalar)}
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


ROOT = Path(__file__).resolve().parent.parent
_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include "(.+)"\n', re.MULTILINE)
_KERNEL = re.compile(r"^(?:__global__ )?void (\w+)\((.*?)\)\s*\{\n(.*?)^\}\n", re.MULTILINE | re.DOTALL)


class Source(NamedTuple):
    """A kernel as it stands in its file."""

    parameters: dict[str, str]
    """C++ types by name, in order."""
    body: str


def _included(text: str, folder: Path) -> str:
    """`text` with the files that it includes, relative to `folder`."""

    def read(match: re.Match[str]) -> str:
        path = folder / match[1]
        return _included(path.read_text(encoding="utf-8"), path.parent)

    return _INCLUDE.sub(read, text)


def _parameters(text: str) -> dict[str, str]:
    declared = " ".join(line.split("//")[0] for line in text.splitlines())
    pairs = (re.fullmatch(r"\s*(.+?)\s*(\w+)(\[\w+\])?\s*", parameter) for parameter in declared.split(","))
    return {pair[2]: pair[1] + (pair[3] or "") for pair in pairs if pair}


@functools.cache
def kernel_source(path: str, name: str) -> Source:
    """The kernel `name` of the file `path`, which is relative to the package.

    Raises:
        ValueError: the file has no such kernel.
    """
    file = ROOT / path
    for found in _KERNEL.finditer(file.read_text(encoding="utf-8")):
        if found[1] == name:
            return Source(_parameters(_included(found[2], file.parent)), _included(found[3], file.parent))
    raise ValueError(f"name: expected a kernel of {path}, got {name!r}.")


def header_source(path: str) -> str:
    """The text of a header."""
    file = ROOT / path
    return _included(file.read_text(encoding="utf-8"), file.parent)


def defined(constants: Mapping[str, object], text: str) -> str:
    """`text` in which each of `constants` is a macro."""
    names = {name: " ".join(str(value).split()) for name, value in constants.items()}
    before = "".join(f"#define {name} {value}\n" for name, value in names.items())
    return before + text + "".join(f"#undef {name}\n" for name in names)
