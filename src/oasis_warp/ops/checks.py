"""Checks of arguments of public functions, with messages of the form `argument: expected X, got Y. Hint`."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

FLOATS = torch.float32, torch.float64
DEVICES = "cpu", "cuda"
WHOLE = int, torch.SymInt
NUMBERS = int, float, torch.SymInt, torch.SymFloat
MAX_SIDE = 2**23
"""Largest side of an image or a tile [px]: float32 counts halves of pixels up to there, and products with 2^8 fit in
int32."""
FINITE_LIMIT = 1e15
"""Largest accepted magnitude: its square still fits in float32."""


def _sentence(name: str, expected: str, got: str, hint: str) -> str:
    return f"{name}: expected {expected}, got {got}." + (f" {hint}" if hint else "")


def check_tensor(name: str, tensor: Tensor, hint: str = "") -> None:
    """Check that `tensor` is one, and dense.

    Raises:
        TypeError: it is not.
    """
    if not isinstance(tensor, Tensor):
        raise TypeError(_sentence(name, "a torch.Tensor", type(tensor).__name__, hint))
    if tensor.layout != torch.strided:
        got = f"one with layout {str(tensor.layout).removeprefix('torch.')}"
        raise TypeError(_sentence(name, "a dense tensor", got, "Call its to_dense()."))


def check_shape(
    name: str, tensor: Tensor, *shape: int | str, sizes: dict[str, int] | None = None, hint: str = ""
) -> None:
    """Check that `tensor` has `shape`; a letter is any size, but the same over all calls with `sizes`.

    Raises:
        TypeError: `tensor` is no tensor.
        ValueError: another shape.
    """
    check_tensor(name, tensor, hint)
    sizes = {} if sizes is None else sizes
    got = tensor.shape
    fits = len(shape) == len(got)
    if fits:
        for want, size in zip(shape, got, strict=True):
            if size != (sizes.get(want, size) if isinstance(want, str) else want):
                fits = False
    if not fits:
        known = ", ".join(str(sizes.get(s, s) if isinstance(s, str) else s) for s in shape)
        raise ValueError(_sentence(name, f"shape [{known}]", f"{list(got)}", hint))
    for want, size in zip(shape, got, strict=True):
        if isinstance(want, str):
            sizes[want] = size


def check_float(name: str, tensor: Tensor, like: Tensor | None = None) -> None:
    """Check that `tensor` is float32 or float64 and, if `like` is given, of its dtype and device.

    Raises:
        ValueError: another dtype or device.
    """
    if tensor.dtype not in FLOATS:
        raise ValueError(_sentence(name, "float32 or float64", str(tensor.dtype).removeprefix("torch."), ""))
    if like is None and tensor.device.type not in DEVICES:
        raise ValueError(_sentence(name, "a tensor on cpu or cuda", f"one on {tensor.device}", ""))
    if like is not None and (tensor.dtype != like.dtype or tensor.device != like.device):
        raise ValueError(
            _sentence(name, f"{like.dtype} on {like.device}", f"{tensor.dtype} on {tensor.device}",
                      "All arguments of one call share them.")
        )


def check_like(name: str, tensor: Tensor, shape: tuple[int, ...], like: Tensor, hint: str = "") -> None:
    """`check_shape` and `check_float` in one call, for known sizes; `like` is a checked tensor.

    Raises:
        TypeError: `tensor` is no tensor.
        ValueError: another shape, dtype or device.
    """
    if isinstance(tensor, Tensor) and tensor.shape == shape and tensor.layout == torch.strided:
        if tensor.dtype != like.dtype or tensor.device != like.device:
            check_float(name, tensor, like)
    else:
        check_shape(name, tensor, *shape, hint=hint)


def refuse_gradient(caller: str, **tensors: Tensor | None) -> None:
    """Refuse tensors that require a gradient although the operator `caller` is constant in them.

    Raises:
        ValueError: one does, and torch records gradients.
    """
    for name, tensor in tensors.items():
        if tensor is not None and tensor.requires_grad and torch.is_grad_enabled():
            hint = f"{caller} has no derivative with respect to it; pass {name}.detach()."
            raise ValueError(_sentence(name, "a tensor that needs no gradient", "one with requires_grad", hint))


def check_device(name: str, tensor: Tensor | None, like: Tensor | None) -> None:
    """Check that `tensor` lies where the checked tensor `like` does, where both are there.

    Raises:
        ValueError: it does not.
    """
    if tensor is not None and like is not None and tensor.device != like.device:
        raise ValueError(_sentence(name, f"a tensor on {like.device}", f"one on {tensor.device}", ""))


def check_kinds(names: Sequence[str], arguments: Sequence[Any]) -> None:
    """Refuse arguments that no custom op takes; torch names them with its schema.

    Raises:
        TypeError: names the argument.
    """
    for name, argument in zip(names, arguments, strict=True):
        if not isinstance(argument, Tensor | bool | int | float | list | torch.SymInt | torch.SymFloat | None):
            raise TypeError(f"{name}: expected a tensor, a number or a flag, got {type(argument).__name__}.")


def check_finite(**tensors: Tensor | None) -> None:
    """Refuse NaN, infinities and huge magnitudes, which kernels could hide in a plausible picture.

    Raises:
        ValueError: some values are bad.
    """
    for name, tensor in tensors.items():
        if tensor is None or tensor.numel() == 0:
            continue
        low, high = torch.aminmax(tensor.detach())  # one pass; NaN stays NaN and fails both comparisons
        if not bool((low >= -FINITE_LIMIT) & (high <= FINITE_LIMIT)):
            bad = int((~(tensor.detach().abs() <= FINITE_LIMIT)).sum())
            raise ValueError(
                _sentence(name, f"finite values below {FINITE_LIMIT:g}", f"{bad} of {tensor.numel()} that are not", "")
            )


def check_integer(name: str, tensor: Tensor) -> None:
    """Check that `tensor` is int32 or int64.

    Raises:
        ValueError: another dtype.
    """
    if tensor.dtype not in (torch.int32, torch.int64):
        raise ValueError(_sentence(name, "int32 or int64", str(tensor.dtype).removeprefix("torch."), ""))


def check_index(name: str, tensor: Tensor, size: int, what: str, least: int = 0) -> None:
    """Check that integer `tensor` lies in [least, size).

    Raises:
        ValueError: not an integer tensor, or an index out of range.
    """
    check_integer(name, tensor)
    if tensor.numel():
        low, high = (int(v) for v in torch.aminmax(tensor))
        if low < least or high >= size:
            raise ValueError(
                _sentence(name, f"indices in {least} .. {size - 1} ({size} {what})", f"values from {low} to {high}", "")
            )


def check_whole(name: str, value: int, what: str, least: int, most: int) -> None:
    """Check that `value` is a whole number of `what` in [least, most].

    Raises:
        ValueError: it is not.
    """
    if not isinstance(value, WHOLE) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(_sentence(name, f"a whole number of {what} from {least} to {most}", repr(value), ""))


def check_pixels(name: str, value: int) -> None:
    """Check that `value` is the length of a side of an image or a tile [px].

    Raises:
        ValueError: it is not.
    """
    check_whole(name, value, "pixels", 1, MAX_SIDE)


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Check that `value` is one of `choices`.

    Raises:
        ValueError: it is not.
    """
    if value not in choices:
        raise ValueError(_sentence(name, "one of " + ", ".join(repr(c) for c in choices), repr(value), ""))


def check_number(name: str, value: float) -> None:
    """Check that `value` is a plain number.

    Raises:
        TypeError: it is not.
    """
    if not isinstance(value, NUMBERS) or isinstance(value, bool):
        raise TypeError(_sentence(name, "a number", type(value).__name__, ""))


def check_positive(name: str, value: float) -> None:
    """Check that the number `value` is positive and finite.

    Raises:
        TypeError: it is no number.
        ValueError: it is not.
    """
    check_number(name, value)
    if not 0 < value < float("inf"):
        raise ValueError(_sentence(name, "a positive finite number", repr(value), ""))
