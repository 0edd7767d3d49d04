"""Read safetensors files, which execute no code; errors are one sentence."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.data.json_text import read_json


@contextmanager
def open_tensors(path: Path, content: str, source: str, remedy: str = "copy it again") -> Iterator[Any]:
    """Yield the open file.

    Args:
        path: Path of the file.
        content: What it holds, for messages.
        source: Where to get such a file, for messages.
        remedy: What to do about a damaged one.

    Raises:
        InputError: no such file, another format, or cut short, also if the block finds out.
    """
    if not os.path.isfile(path):  # unlike Path.is_file, it takes names of any length
        found = "a folder" if os.path.isdir(path) else "no such file"
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


def read_entry(path: Path, file: Any, name: str, remedy: str) -> dict[str, Any] | None:
    """The JSON object in the entry `name` of the metadata of an open file; None where there is no such entry.

    Raises:
        InputError: it is no JSON object.
    """
    text = (file.metadata() or {}).get(name)
    if text is None:
        return None
    try:
        return read_json(text)
    except ValueError as error:
        raise InputError(f"{path}: damaged, its header cannot be read ({error}); {remedy}.") from error


def read_tensors(path: Path, file: Any, expected: Mapping[str, Tensor], remedy: str) -> dict[str, Tensor]:
    """All tensors of an open file, which must have the names and shapes of `expected` and be finite, as float32.

    Raises:
        InputError: a tensor is missing, unknown, of another shape or type, or not finite.
    """
    shapes = tensor_shapes(file)
    want = {name: list(tensor.shape) for name, tensor in expected.items()}
    wrong = sorted(n for n in want.keys() | shapes.keys() if n not in shapes or want.get(n) != shapes[n][1])
    if wrong:
        raise InputError(
            f"{path}: {len(wrong)} tensors do not fit the network that the header describes, {shortened(wrong[0])} "
            f"first; {remedy}."
        )
    tensors = {}
    for name, (dtype, _) in shapes.items():
        if dtype not in FLOATS:
            raise InputError(f"{path}: damaged, {name} holds {dtype} instead of real numbers; {remedy}.")
        tensors[name] = file.get_tensor(name).float()
        if not bool(tensors[name].isfinite().all()):
            raise InputError(f"{path}: damaged, {name} holds values that are not finite; {remedy}.")
    return tensors


FLOATS = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
DTYPES = {
    "F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "I64": torch.int64,
    "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8, "BOOL": torch.bool,
}  # fmt: skip


def tensor_shapes(file: Any) -> dict[str, tuple[torch.dtype | None, list[int]]]:
    """Type, None where it is a rare one, and shape of every tensor, without reading any."""
    slices = {name: file.get_slice(name) for name in file.keys()}
    return {name: (DTYPES.get(part.get_dtype()), part.get_shape()) for name, part in slices.items()}
