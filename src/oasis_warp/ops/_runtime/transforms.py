"""Operators under the transforms of torch.func: reverse mode and vmap work, forward mode is refused in words."""

import inspect
import typing
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad


def schema_of(function: Callable[..., Any]) -> str:
    """The schema of a custom op, read from the annotations of a function; torch 2.6 knows lists by another name."""

    def named(annotation: Any) -> Any:
        kind, inner = typing.get_origin(annotation), typing.get_args(annotation)
        if kind is tuple:
            return tuple[tuple(map(named, inner))]
        return typing.List[inner[0]] if kind is list else annotation  # noqa: UP006

    def described() -> None: ...

    signature = inspect.signature(function)
    parameters = [p.replace(annotation=named(p.annotation)) for p in signature.parameters.values()]
    described.__signature__ = inspect.Signature(parameters, return_annotation=named(signature.return_annotation))
    return torch.library.infer_schema(described, mutates_args=())


def refuse_forward_mode(caller: str, arguments: Any) -> None:
    """Refuse tensors that carry a tangent: results would have none, as if they were constant.

    Raises:
        RuntimeError: names the operator, and what to use instead.
    """
    for argument in arguments:
        if isinstance(argument, list | tuple):
            refuse_forward_mode(caller, argument)
        elif isinstance(argument, Tensor) and forward_ad.unpack_dual(argument).tangent is not None:
            _refuse_jvp(caller)


def _refuse_jvp(caller: str) -> None:
    raise RuntimeError(
        f"{caller}: expected a derivative in reverse mode, got one in forward mode (jvp, jacfwd, hessian, forward_ad). "
        "Use backward, torch.func.grad, vjp or jacrev."
    )


def in_forward_mode() -> bool:
    """Whether tensors may carry tangents. Takes 50 ns."""
    return forward_ad._current_level >= 0


def in_transform() -> bool:
    """Whether a transform of torch.func is active, and torch.compile is not, which has its own way with them."""
    return not torch.compiler.is_compiling() and torch._C._are_functorch_transforms_active()


def wants_gradient(tensor: Tensor) -> bool:
    """Whether `tensor`, or what a transform of torch.func wraps in it, requires a gradient."""
    if not tensor.requires_grad and in_transform() and torch._C._functorch.is_functorch_wrapped_tensor(tensor):
        return wants_gradient(torch._C._functorch.get_unwrapped(tensor))
    return tensor.requires_grad


def transformable(
    name: str,
    caller: str,
    run: Callable[..., Any],
    save: Callable[..., None],
    differentiate: Callable[..., Any],
) -> Callable[..., Any]:
    """`run`, a custom op, as torch.func can transform it; `vmap` runs it once for each entry.

    Args:
        name: Name of the class.
        caller: The operator that messages name.
        run: Of tensors, numbers and lists of them, to a tensor or a tuple. Of lists in that no derivative is known.
        save: The `setup_context` of a torch.autograd.Function.
        differentiate: Its `backward`.
    """

    def jvp(ctx: Any, *_: Any) -> None:
        _refuse_jvp(caller)

    def vmap(info: Any, in_dims: tuple[Any, ...], *arguments: Any) -> tuple[Any, Any]:
        parts = [apply(*_entry(list(arguments), list(in_dims), k)) for k in range(info.batch_size)]
        if isinstance(parts[0], Tensor):
            return torch.stack(parts), 0
        stacked = [_stacked(caller, results) for results in zip(*parts, strict=True)]
        return type(parts[0])(stacked), type(parts[0])([] if isinstance(some, list) else 0 for some in stacked)

    methods = {"forward": run, "setup_context": save, "backward": differentiate, "jvp": jvp, "vmap": vmap}
    function = type(name, (torch.autograd.Function,), {key: staticmethod(value) for key, value in methods.items()})
    apply: Callable[..., Any] = function.apply  # pyright: ignore[reportAttributeAccessIssue]
    return apply


def _entry(arguments: list[Any], in_dims: list[Any], k: int) -> list[Any]:
    """Entry `k` of the arguments that are batched along `in_dims`."""
    return [
        _entry(argument, dim, k) if isinstance(argument, list) else argument if dim is None else argument.select(dim, k)
        for argument, dim in zip(arguments, in_dims, strict=True)
    ]


def _stacked(caller: str, results: tuple[Any, ...]) -> Any:
    """One result of every entry: tensors along a new axis. Lists hold what the adjoint needs of one call."""
    if isinstance(results[0], Tensor):
        return torch.stack(results)
    if any(results):
        raise RuntimeError(
            f"{caller}: expected one call whose gradient is wanted, got vmap over several. "
            "Call it in a loop, or give it all cameras at once."
        )
    return []
