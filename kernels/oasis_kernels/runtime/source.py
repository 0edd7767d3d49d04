"""C++ of the kernels: functions in the `.cpp` and `.cu` files of this package, read as text and compiled by Warp.

A kernel is a function at the left margin. Its parameters become those of the launch, its body the text of a Warp
snippet, both with the files that they include put in their places. Headers (`.h`) hold what the bodies of several
kernels share; they are included inside of functions, so that their lambdas see the parameters. Parameters that several
kernels share stand in lists of their own (`.inc`).
"""

import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

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
