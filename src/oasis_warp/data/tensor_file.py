"""Read safetensors files, which execute nothing, or say in one sentence what is wrong with them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open

from oasis_warp.core.errors import InputError


@contextmanager
def open_tensors(path: Path, content: str, source: str, remedy: str = "copy it again") -> Iterator[Any]:
    """Yield the open file.

    Args:
        path: Of the file.
        content: What it holds, for messages.
        source: Where to get such a file, for messages.
        remedy: What to do about a damaged one.

    Raises:
        InputError: no such file, another format, or cut short, also if the block finds out.
    """
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise InputError(f"{path}: expected {content}, found {found}; {source}.")
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except SafetensorError as error:
        raise InputError(
            f"{path}: expected {content}, got another format or a file cut short ({error}); {remedy}."
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file's permissions.") from error


DTYPES = {
    "F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "I64": torch.int64,
    "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8, "BOOL": torch.bool,
}  # fmt: skip


def tensor_shapes(file: Any) -> dict[str, tuple[torch.dtype | None, list[int]]]:
    """Type, None where it is a rare one, and shape of every tensor, without reading any."""
    slices = {name: file.get_slice(name) for name in file.keys()}
    return {name: (DTYPES.get(part.get_dtype()), part.get_shape()) for name, part in slices.items()}
