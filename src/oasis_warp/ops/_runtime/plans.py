"""Shared parts of planned calls on CUDA: cache of plans, workspace layout, and once-differentiable gradients."""

import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import Function
from torch.nn import Parameter

MAX_PLANS = 32
"""Kinds of calls that a thread remembers."""
ALIGNMENT = 256
"""Of the arrays in a workspace [bytes]."""


class Plans(threading.local):
    """Thread-local plans by kind of call; the oldest is dropped."""

    def __init__(self) -> None:
        self.plans: dict[tuple[Any, ...], Any] = {}

    def keep(self, key: tuple[Any, ...], plan: Any) -> Any:
        """Remember `plan`, and return it."""
        while len(self.plans) >= MAX_PLANS:
            del self.plans[next(iter(self.plans))]
        self.plans[key] = plan
        return plan


def shapes_of(tensors: Iterable[Tensor | None], device: int) -> list[Any] | None:
    """Shapes of plain float32 tensors on a CUDA device; None where one is of another kind."""
    shapes: list[Any] = []
    for tensor in tensors:
        if tensor is None:
            shapes.append(None)
            continue
        kind = type(tensor)
        if (
            (kind is not Tensor and kind is not Parameter)
            or tensor.dtype is not torch.float32
            or tensor.get_device() != device
            or tensor.layout is not torch.strided
            or tensor.is_neg()
        ):
            return None
        shapes.append(tensor.shape)
    return shapes


def lay_out(sizes: Mapping[str, int], start: int = 0) -> tuple[dict[str, int], int]:
    """Places of arrays of these `sizes` after `start`, and where they end [bytes]."""
    places, end = {}, start
    for name, size in sizes.items():
        places[name], end = end, end + -(-size // ALIGNMENT) * ALIGNMENT
    return places, end


def addresses(tensors: Iterable[Tensor | None]) -> list[int]:
    """Of memory on the device; 0 for None."""
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


class _DifferentiableOnce(Function):
    """Gradients that have no derivative."""

    @staticmethod
    def forward(ctx: Any, caller: str, count: int, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        ctx.caller = caller
        return tuple(None if tensor is None else tensor.view_as(tensor) for tensor in tensors[count:])

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise RuntimeError(
            f"{ctx.caller}: expected one derivative, got a request for the second. "
            "It is differentiable once; detach the gradient before you go on with it."
        )


def differentiable_once(caller: str, inputs: Sequence[Tensor | None], gradients: Sequence[Tensor | None]) -> Any:
    """`gradients`, which raise if autograd wants to go through them (create_graph=True)."""
    return _DifferentiableOnce.apply(caller, len(inputs), *inputs, *gradients) if torch.is_grad_enabled() else gradients
