"""Operators as torch knows them: custom ops, so that `torch.compile` sees one node each and never looks inside.

A differentiable operator is two custom ops, each a function of tensors and plain numbers: the forward one, and its
adjoint, which has no derivative of its own. What only the data can size (lists of pairs, say) passes between them
hidden, because a compiled graph must know every shape beforehand: see `hidden`.

Torch takes 15 to 60 us for each call of a custom op, more than a GPU takes to draw a hand. So where nobody traces the
call its implementation runs straight, under a plain `torch.autograd.Function` where a gradient is wanted.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import Function
from torch.nn import Parameter

from oasis_warp.core.tracing import is_traced

NAMESPACE = "oasis_warp"


class Operator:
    """A custom op, also known to torch as torch.ops.oasis_warp.`name`, that costs little where nobody traces it.

    Arguments come by position. A list of tensors takes no gradient on the straight way: where one is wanted by a tensor
    of a list, the call goes through torch.
    """

    def __init__(self, name: str, implementation: Callable[..., Any], fake: Callable[..., Any]) -> None:
        self.custom_op = torch.library.custom_op(f"{NAMESPACE}::{name}", implementation, mutates_args=())
        self.custom_op.register_fake(fake)
        self._name = name
        self._implementation = implementation
        self._traced = getattr(getattr(torch.ops, NAMESPACE), name).default
        self._differentiated: Callable[..., Any] = self._traced  # that keeps the derivative, or the refusal, in a graph

    def differentiate(self, backward: Callable[..., Any], save: Callable[..., None]) -> None:
        """See `differentiable`."""
        self.custom_op.register_autograd(backward, setup_context=save)
        self._differentiated = _function(self._name, self._implementation, backward, save)

    def __call__(self, *arguments: Any) -> Any:
        if is_traced():
            return self._traced(*arguments)
        tracks = torch.is_grad_enabled()
        wanted = False
        for argument in arguments:
            kind = type(argument)
            if kind is Tensor or kind is Parameter:
                if argument.is_neg():  # memory holds the opposite of what it stands for: the dispatcher resolves that
                    return self._traced(*arguments)
                if tracks and argument.requires_grad:
                    wanted = True
            elif kind is list:
                for item in argument:
                    if type(item) is Tensor:
                        if item.is_neg() or (tracks and item.requires_grad):
                            return self._traced(*arguments)
                    elif type(item) not in _NUMBERS:
                        return self._traced(*arguments)
            elif kind not in _NUMBERS:  # a kind of tensor with its own way through ops, such as a fake one
                return self._traced(*arguments)
        return self._differentiated(*arguments) if wanted else self._implementation(*arguments)


_NUMBERS = frozenset({bool, int, float, type(None)})


def _function(
    name: str, implementation: Callable[..., Any], backward: Callable[..., Any], save: Callable[..., None]
) -> Callable[..., Any]:
    """The derivative of `Operator.differentiate` without the dispatcher."""

    def run(ctx: Any, *arguments: Any) -> Any:
        output = implementation(*arguments)
        save(ctx, arguments, output)
        return output

    def run_backward(ctx: Any, *gradients: Any) -> Any:
        found = backward(ctx, *gradients)
        for gradient in found:
            if type(gradient) is list:  # those by a list's tensors, all None: to a Function the list is one argument
                return tuple(None if type(g) is list else g for g in found)
        return found

    function = type(name, (Function,), {"forward": staticmethod(run), "backward": staticmethod(run_backward)})
    # Below Function.apply, which takes 3 us to look for functorch: `is_traced` has.
    return super(Function, function).apply


def operator(name: str, implementation: Callable[..., Any], fake: Callable[..., Any]) -> Operator:
    """Register `implementation` as torch.ops.oasis_warp.`name`; its annotations are the schema.

    Args:
        name: Of the op.
        implementation: From tensors and numbers to fresh tensors that alias neither the inputs nor each other.
        fake: The same arguments to empty tensors of the shapes, types and strides that come out.
    """
    return Operator(name, implementation, fake)


def adjoint(name: str, implementation: Callable[..., Any], fake: Callable[..., Any]) -> Operator:
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

    op.custom_op.register_autograd(refuse)
    return op


def differentiable(op: Operator, backward: Callable[..., Any], save: Callable[..., None]) -> None:
    """Give a forward `operator` its derivative.

    Args:
        op: What `operator` returned.
        backward: (ctx, one gradient an output) to one gradient or None an input, for an input that is a list of
            tensors a list of them; calls an `adjoint`. An output that is a list receives whatever: give it none.
        save: (ctx, inputs, output) keeps what `backward` needs.
    """
    op.differentiate(backward, save)


def hidden(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A buffer for `size` elements, as `revealed` shows it, in the form of a tensor of one element.

    The one element lies at the start of a longer storage: shapes stay known, the storage travels along.
    """
    return torch.empty(size + 1, dtype=dtype, device=device).resize_(1)


def revealed(buffer: Tensor) -> Tensor:
    """All elements of a `hidden` buffer."""
    return buffer.as_strided((buffer.untyped_storage().nbytes() // buffer.element_size() - 1,), (1,))


def hidden_like_fake(dtype: torch.dtype, device: torch.device) -> Tensor:
    """What `hidden` looks like from outside, for a fake."""
    return torch.empty(1, dtype=dtype, device=device)


def needs_gradient(*tensors: Tensor | None) -> bool:
    """Whether torch will ask for a gradient by one of `tensors`: otherwise nothing need be kept for the adjoint."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)
