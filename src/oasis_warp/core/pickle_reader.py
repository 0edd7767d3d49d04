"""Numbers out of pickles and .npz without executing them: MANO's model files, motions, what hand estimators write.

A pickle is a program for a stack machine. The machine here has only the instructions that build plain values, and of
all names in a file it knows the few that stand for arrays. Nothing is imported or called, whatever a file says.
"""

import io
import pickle
import pickletools
import re
import warnings
import zipfile
import zlib
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from oasis_warp.core.errors import InputError, shortened

MAX_BYTES = 256 << 20
"""Largest file: MANO's have 4 MB, an estimator's a few for each hand."""
MAX_INSTRUCTIONS = 2_000_000
"""A million of them take about two seconds."""
MAX_DIMENSIONS, MAX_NESTED = 8, 20
"""Most dimensions of an array, and deepest nesting of arrays that name other arrays."""
_NUMBER = re.compile(r"[<>=|]?[fiub][1248]")


class _Mark: ...


class _Name(NamedTuple):
    """A global of a module, by name only; nothing is imported."""

    name: str


class _Made:
    """A call of a global: its arguments, and the state that was set afterwards."""

    def __init__(self, name: str, arguments: tuple[Any, ...]):
        self.name, self.arguments, self.state = name, arguments, None


_ARRAYS = {f"numpy.{core}.multiarray._reconstruct" for core in ("core", "_core")}
_SCALARS = {f"numpy.{core}.multiarray.scalar" for core in ("core", "_core")}
_BUFFERS = {f"numpy.{core}.numeric._frombuffer" for core in ("core", "_core")}
_SPARSE = {"scipy.sparse.csc.csc_matrix", "scipy.sparse._csc.csc_matrix"}
_CHUMPY, _SELECT = "chumpy.ch.Ch", "chumpy.reordering.Select"
_OBJECTS = {"copy_reg._reconstructor", "copyreg._reconstructor"}
_KNOWN = {
    *_ARRAYS, *_SCALARS, *_BUFFERS, *_SPARSE, *_OBJECTS, _CHUMPY, _SELECT, "numpy.ndarray", "numpy.dtype",
    "_codecs.encode", "__builtin__.object", "builtins.object", "collections.OrderedDict", "collections.defaultdict",
}  # fmt: skip


def read_pickle(path: Path | str, what: str, content: bytes | None = None) -> Any:
    """The value in a pickle: numbers, texts, lists, dicts and arrays; sparse matrices become csc arrays.

    Args:
        path: The file.
        what: What it should be, for messages: "MANO's model".
        content: Its bytes, where they lie elsewhere; `path` is for messages then.

    Raises:
        InputError: no such file, larger than `MAX_BYTES`, damaged, or anything in it that is not a plain value.
    """
    path = Path(path)
    content = _content(path, what) if content is None else content
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of odd escapes in texts, from the decoder
            return _plain(_run(content), 0)
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, EOFError, MemoryError, RecursionError,
            AttributeError, pickle.UnpicklingError) as error:  # fmt: skip
        reason = shortened(str(error).rstrip(".")) or type(error).__name__
        raise InputError(f"{path}: expected {what}, got no pickle of plain arrays ({reason}); get it again.") from error


def read_npz(path: Path, names: Container[str] | None = None, content: bytes | None = None) -> dict[str, Any]:
    """Arrays of an .npz, by name.

    Args:
        path: The file.
        names: Names that are read; all when not given.
        content: Its bytes, where they lie elsewhere; `path` is for messages then.

    Raises:
        InputError: no such file, more than `MAX_BYTES` when unpacked, damaged, or arrays of other things than numbers.
    """

    def opened() -> Path | io.BytesIO:
        return path if content is None else io.BytesIO(content)

    try:
        with zipfile.ZipFile(opened()) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise InputError(f"{path}: unpacks to more than {MAX_BYTES >> 20} MB; give less of it.")
        with np.load(opened(), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files if names is None or name in names}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the name.") from error
    except InputError:
        raise
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError,
            RuntimeError, SyntaxError, TypeError, zlib.error, OverflowError, MemoryError) as error:  # fmt: skip
        raise InputError(f"{path}: expected arrays of numbers in an .npz, got something else; save again.") from error


def _content(path: Path, what: str) -> bytes:
    try:
        if not path.is_file():
            found = "a folder" if path.is_dir() else "no such file"
            raise InputError(f"{path}: expected {what}, found {found}; check the name.")
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: expected {what}, got more than {MAX_BYTES >> 20} MB; give the right file.")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the permissions.") from error


def _run(content: bytes) -> Any:
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for count, (code, argument, _) in enumerate(pickletools.genops(content)):
        if count >= MAX_INSTRUCTIONS:
            raise ValueError(f"more than {MAX_INSTRUCTIONS} instructions")
        name = code.name
        if name == "STOP":
            if len(stack) != 1:
                raise ValueError(f"{len(stack)} values where one was expected")
            return stack[0]
        if name in _CONSTANTS:
            stack.append(_CONSTANTS[name]())
        elif name in _LITERALS:
            stack.append(argument)
        elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            memo[len(memo) if argument is None else argument] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif name in _STEPS:
            _STEPS[name](stack, argument)
        elif name not in ("PROTO", "FRAME"):
            raise ValueError(f"the instruction {name}, which no plain value needs")
    raise ValueError("it ends too early")


def _marked(stack: list[Any]) -> list[Any]:
    """Pop everything above the last mark, and the mark."""
    for k in range(len(stack) - 1, -1, -1):
        if stack[k] is _Mark:
            items = stack[k + 1 :]
            del stack[k:]
            return items
    raise ValueError("a missing mark")


def _fill(stack: list[Any], pairs: list[Any]) -> None:
    if not isinstance(stack[-1], dict) or len(pairs) % 2:
        raise ValueError("items that belong to no dict")
    stack[-1].update(zip(pairs[::2], pairs[1::2], strict=True))


def _dict(stack: list[Any]) -> None:
    pairs = _marked(stack)
    stack.append({})
    _fill(stack, pairs)


def _extend(stack: list[Any], items: list[Any]) -> None:
    if not isinstance(stack[-1], list):
        raise ValueError("items that belong to no list")
    stack[-1].extend(items)


def _take(stack: list[Any], count: int) -> list[Any]:
    if len(stack) < count:
        raise ValueError("a value is missing")
    items = stack[len(stack) - count :]
    del stack[len(stack) - count :]
    return items


def _name(stack: list[Any], name: str) -> None:
    if name not in _KNOWN:
        raise ValueError(f"the name {shortened(name)}, which is not a plain array's and is not loaded")
    stack.append(_Name(name))


def _call(stack: list[Any], _: Any) -> None:
    made, arguments = _take(stack, 2)
    if not isinstance(made, _Name) or not isinstance(arguments, tuple):
        raise ValueError("a call of what is no name")
    name = made.name
    if name in _OBJECTS:
        if not arguments or not isinstance(arguments[0], _Name):
            raise ValueError("an object of no class")
        name, arguments = arguments[0].name, ()
    if name == "_codecs.encode":
        text, coding = arguments if len(arguments) == 2 else (None, None)
        if not isinstance(text, str) or coding not in ("latin1", "latin-1"):
            raise ValueError("an encoding other than latin1")
        stack.append(text.encode("latin1"))
    elif name.startswith("collections."):
        stack.append({})
    else:
        stack.append(_Made(name, arguments))


def _build(stack: list[Any], _: Any) -> None:
    (state,) = _take(stack, 1)
    if not isinstance(stack[-1], _Made):
        raise ValueError("a state for what has none")
    stack[-1].state = state


_CONSTANTS: dict[str, Callable[[], Any]] = {
    "MARK": lambda: _Mark, "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False,
    "EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "EMPTY_DICT": dict,
}  # fmt: skip
_LITERALS = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINUNICODE", "BINBYTES", "BINBYTES8",
    "SHORT_BINBYTES", "BYTEARRAY8",
}  # fmt: skip
_STEPS: dict[str, Callable[[list[Any], Any], Any]] = {
    "POP": lambda stack, _: _take(stack, 1),
    "POP_MARK": lambda stack, _: _marked(stack),
    "DUP": lambda stack, _: stack.append(stack[-1]),
    "LIST": lambda stack, _: stack.append(_marked(stack)),
    "TUPLE": lambda stack, _: stack.append(tuple(_marked(stack))),
    "TUPLE1": lambda stack, _: stack.append(tuple(_take(stack, 1))),
    "TUPLE2": lambda stack, _: stack.append(tuple(_take(stack, 2))),
    "TUPLE3": lambda stack, _: stack.append(tuple(_take(stack, 3))),
    "DICT": lambda stack, _: _dict(stack),
    "APPEND": lambda stack, _: _extend(stack, _take(stack, 1)),
    "APPENDS": lambda stack, _: _extend(stack, _marked(stack)),
    "SETITEM": lambda stack, _: _fill(stack, _take(stack, 2)),
    "SETITEMS": lambda stack, _: _fill(stack, _marked(stack)),
    "GLOBAL": lambda stack, name: _name(stack, name.replace(" ", ".")),
    "STACK_GLOBAL": lambda stack, _: _name(stack, ".".join(map(str, _take(stack, 2)))),
    "REDUCE": _call,
    "NEWOBJ": _call,
    "BUILD": _build,
}


def _plain(value: Any, depth: int) -> Any:
    """`value` with the arrays built from their descriptions."""
    if depth > MAX_NESTED:
        raise ValueError(f"values nested more than {MAX_NESTED} deep")
    if isinstance(value, _Name) or value is _Mark:
        raise ValueError("a name in the place of a value")
    if isinstance(value, dict):
        return {key: _plain(item, depth + 1) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(item, depth + 1) for item in value)
    return _array(value, depth + 1) if isinstance(value, _Made) else value


def _array(made: _Made, depth: int) -> Any:
    state, name = made.state, made.name
    if name in _ARRAYS:
        _, shape, dtype, fortran, content = state if isinstance(state, tuple) and len(state) == 5 else [None] * 5
        return _numbers(content, dtype, shape, "F" if fortran else "C")
    if name in _BUFFERS:
        content, dtype, shape, order = made.arguments
        return _numbers(content, dtype, shape, order)
    if name in _SCALARS:
        dtype, content = made.arguments
        return _numbers(content, dtype, (), "C")[()]
    if not isinstance(state, dict):
        raise ValueError(f"{name} without its state")
    if name == _CHUMPY:
        return _dense(_plain(state["x"], depth), name)
    if name == _SELECT:
        source, index = (_dense(_plain(state[key], depth), name) for key in ("a", "idxs"))
        return source.ravel()[index.ravel().astype(np.int64)].reshape(_shape(state["preferred_shape"]))
    if name in _SPARSE:
        return _sparse(_plain({key: state.get(key) for key in ("data", "indices", "indptr")}, depth),
                       _shape(state.get("_shape", state.get("shape"))))  # fmt: skip
    raise ValueError(f"{name} in the place of a value")


def _dense(value: Any, name: str) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        raise ValueError(f"{name} of what is no array")
    return value


def _shape(shape: Any) -> tuple[int, ...]:
    if isinstance(shape, np.ndarray):
        shape = tuple(shape.tolist())
    if not isinstance(shape, tuple | list) or len(shape) > MAX_DIMENSIONS:
        raise ValueError("an array without a shape")
    sizes = tuple(int(n) for n in shape)
    if any(not 0 <= n < 2**31 for n in sizes):
        raise ValueError(f"an array of shape {shortened(str(sizes))}")
    return sizes


def _dtype(made: Any) -> np.dtype:
    """The type of an array's numbers; its byte order is the third entry of its state."""
    code = made.arguments[0] if isinstance(made, _Made) and made.name == "numpy.dtype" and made.arguments else None
    if isinstance(code, bytes):
        code = code.decode("latin1")
    if not isinstance(code, str) or not _NUMBER.fullmatch(code):
        raise ValueError(f"an array of {shortened(repr(code))}, which are no numbers")
    order = made.state[1] if isinstance(made.state, tuple) and len(made.state) > 1 else "="
    order = order.decode("latin1") if isinstance(order, bytes) else order
    return np.dtype(code).newbyteorder(order if order in ("<", ">") else "=")


def _numbers(content: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    sizes, kind = _shape(shape), _dtype(dtype)
    if isinstance(content, str):
        content = content.encode("latin1")
    if not isinstance(content, bytes | bytearray):
        raise ValueError("an array without numbers")
    want = kind.itemsize
    for n in sizes:
        want *= n
    if want != len(content):
        raise ValueError(f"an array of shape {sizes} with {len(content)} bytes instead of {want}")
    values = np.frombuffer(content, kind).reshape(sizes, order="F" if order == "F" else "C")
    return values.astype(kind.newbyteorder("="), copy=not values.flags.aligned)


def _sparse(parts: dict[str, Any], shape: tuple[int, ...]) -> sparse.csc_array:
    data, indices, starts = (_dense(parts[key], "a sparse matrix") for key in ("data", "indices", "indptr"))
    if len(shape) != 2 or data.ndim != 1 or starts.shape != (shape[1] + 1,) or indices.shape != data.shape:
        raise ValueError("a sparse matrix whose parts do not fit together")
    inside = not len(indices) or (indices.min() >= 0 and indices.max() < shape[0])
    if not inside or starts[0] != 0 or starts[-1] != len(data) or (np.diff(starts) < 0).any():
        raise ValueError("a sparse matrix with entries outside it")
    return sparse.csc_array((data, indices, starts), shape)
