"""Operators as torch knows them: custom ops, so that `torch.compile` sees one node each and never looks inside.

A differentiable operator is two custom ops, each a function of tensors and plain numbers: the forward one, and its
adjoint, which has no derivative of its own. What only the data can size (lists of pairs, say) passes between them
hidden, because a compiled graph must know every shape beforehand: see `hidden`.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

NAMESPACE = "oasis_warp"


def operator(name: str, implementation: Callable[..., Any], fake: Callable[..., Any]) -> Any:
    """Register `implementation` as torch.ops.oasis_warp.`name`; its annotations are the schema.

    Args:
        name: Of the op.
        implementation: From tensors and numbers to fresh tensors that alias neither the inputs nor each other.
        fake: The same arguments to empty tensors of the shapes, types and strides that come out.
    """
    op = torch.library.custom_op(f"{NAMESPACE}::{name}", implementation, mutates_args=())
    op.register_fake(fake)
    return op


def adjoint(name: str, implementation: Callable[..., Any], fake: Callable[..., Any]) -> Any:
    """`operator` for a backward pass: differentiating it is refused.

    Raises:
        RuntimeError: later, when a gradient made with `create_graph=True` is differentiated.
    """
    op = operator(name, implementation, fake)

    def refuse(*_: Any) -> Any:
        raise RuntimeError(
            f"{name.removesuffix('_backward')}: expected one derivative, got a request for the second. "
            "It is differentiable once; detach the gradient before you go on with it."
        )

    op.register_autograd(refuse)
    return op


def differentiable(op: Any, backward: Callable[..., Any], save: Callable[..., None]) -> None:
    """Give a forward `operator` its derivative.

    Args:
        op: What `operator` returned.
        backward: (ctx, one gradient an output) to one gradient or None an input; calls an `adjoint`.
        save: (ctx, inputs, output) keeps what `backward` needs.
    """
    op.register_autograd(backward, setup_context=save)


def hidden(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A buffer for `size` elements, as `revealed` shows it, in the form of a tensor of one element.

    The one element lies at the start of a longer storage: shapes stay known, the storage travels along.
    """
    return torch.empty(size + 1, dtype=dtype, device=device)[:1]


def revealed(buffer: Tensor) -> Tensor:
    """All elements of a `hidden` buffer."""
    whole = torch.empty(0, dtype=buffer.dtype, device=buffer.device).set_(buffer.untyped_storage())
    return whole[:-1]


def hidden_like_fake(dtype: torch.dtype, device: torch.device) -> Tensor:
    """What `hidden` looks like from outside, for a fake."""
    return torch.empty(1, dtype=dtype, device=device)


def needs_gradient(*tensors: Tensor | None) -> bool:
    """Whether torch will ask for a gradient by one of `tensors`: otherwise nothing need be kept for the adjoint."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
