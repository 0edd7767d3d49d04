"""Checks of arguments of public functions, with messages of the form `argument: expected X, got Y. Hint`."""

from collections.abc import Sequence

import torch
from torch import Tensor

FLOATS = torch.float32, torch.float64
FINITE_LIMIT = 1e15
"""Largest accepted magnitude: its square still fits in float32."""


def _sentence(name: str, expected: str, got: str, hint: str) -> str:
    return f"{name}: expected {expected}, got {got}." + (f" {hint}" if hint else "")


def check_shape(
    name: str, tensor: Tensor, *shape: int | str, sizes: dict[str, int] | None = None, hint: str = ""
) -> None:
    """Check that `tensor` has `shape`; a letter is any size, but the same over all calls with `sizes`.

    Raises:
        TypeError: `tensor` is no tensor.
        ValueError: another shape.
    """
    if not isinstance(tensor, Tensor):
        raise TypeError(_sentence(name, "a torch.Tensor", type(tensor).__name__, hint))
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
    if isinstance(tensor, Tensor) and tensor.shape == shape:
        if tensor.dtype != like.dtype or tensor.device != like.device:
            check_float(name, tensor, like)
    else:
        check_shape(name, tensor, *shape, hint=hint)


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


def check_index(name: str, tensor: Tensor, size: int, what: str) -> None:
    """Check that integer `tensor` lies in [0, size).

    Raises:
        ValueError: not an integer tensor, or an index out of range.
    """
    check_integer(name, tensor)
    if tensor.numel():
        low, high = (int(v) for v in torch.aminmax(tensor))
        if low < 0 or high >= size:
            raise ValueError(
                _sentence(name, f"indices in 0 .. {size - 1} ({size} {what})", f"values from {low} to {high}", "")
            )


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Check that `value` is one of `choices`.

    Raises:
        ValueError: it is not.
    """
    if value not in choices:
        raise ValueError(_sentence(name, "one of " + ", ".join(repr(c) for c in choices), repr(value), ""))


def check_positive(name: str, value: float) -> None:
    """Check that the number `value` is positive and finite.

    Raises:
        ValueError: it is not.
    """
    if not 0 < value < float("inf"):
        raise ValueError(_sentence(name, "a positive finite number", repr(value), ""))
