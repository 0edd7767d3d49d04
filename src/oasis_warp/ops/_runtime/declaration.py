"""The declaration of an operator: its arguments, its results, and what torch needs to know to run it.

A differentiable operator is two custom ops, each a function of tensors and plain numbers: `forward`, and its adjoint
`backward`, which has no derivative of its own. `torch.compile` sees one node for each and never looks inside. A list
whose length only the data decides passes between the two as an opaque buffer, because a compiled graph must know every
shape beforehand: see `opaque_buffer`.

A call of a custom op costs torch 15 to 60 us, more than a GPU needs to draw a hand. So if nothing traces the call, its
implementation runs directly, under a plain `torch.autograd.Function` if a gradient is needed.
"""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import Function
from torch.nn import Parameter

from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime import transforms
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops.checks import check_device, check_float, check_kinds, check_shape, refuse_gradient

NAMESPACE = "oasis_warp"
BATCH = "*B"


@dataclass(frozen=True)
class Array:
    """A tensor argument of an operator."""

    shape: str
    """Sizes and letters, one size for each letter in a call: "N 3", "P+Q 4". With "*B " in front, all arguments of a
    call that are so marked have an axis of poses in front, or none has; with "?B ", each has it or has it not."""
    grad: bool = False
    """Whether the operator is differentiable in it."""
    optional: bool = False
    """Whether it may be None."""
    index: str = ""
    """For integers: the letter of the axis that they index; empty for floats."""
    least: int = 0
    """The least index; -1 stands for none."""
    hint: str = ""
    """Appended to messages about its shape."""

    @property
    def dims(self) -> tuple[int | str, ...]:
        """The shape without the batch axis."""
        return tuple(int(d) if d.isdigit() else d for d in self.shape.split() if d[0] not in "*?")


DECLARATIONS: dict[str, "Declaration"] = {}
"""The public operators by name, in the order of their declaration."""


class Declaration:
    """The arguments and results of an operator."""

    def __init__(
        self,
        name: str,
        *,
        inputs: Mapping[str, Array],
        outputs: Mapping[str, str] = MappingProxyType({}),
        reference: str = "",
        public: bool = True,
    ) -> None:
        """Declare an operator.

        Args:
            name: Name of the operator; a public one is `oasis_warp.ops.NAME`.
            inputs: Its tensor arguments, by the names under which messages speak of them.
            outputs: Shapes of its results, in the notation of `Array.shape`.
            reference: "module.function" below `oasis_warp.reference` that computes the same in float64 torch.
            public: Whether to list it in `DECLARATIONS`.
        """
        self.name = name
        self.inputs = MappingProxyType(dict(inputs))
        self.outputs = MappingProxyType(dict(outputs))
        self.reference = reference
        self._shapes = [(k, a.dims, a.shape[0], a.optional, a.hint) for k, a in inputs.items()]
        self._floats = [k for k, a in inputs.items() if not a.index]
        self._indices = [k for k, a in inputs.items() if a.index]
        self._constant = [k for k in self._floats if self.differentiable and not inputs[k].grad]
        if public:
            DECLARATIONS[name] = self

    @property
    def differentiable(self) -> tuple[str, ...]:
        """Names of the inputs that receive gradients."""
        return tuple(name for name, array in self.inputs.items() if array.grad)

    @property
    def function(self) -> Callable[..., Any]:
        """The public function, looked up at the time of the call."""
        from oasis_warp import ops

        return getattr(ops, self.name)

    def check(self, sizes: dict[str, int] | None = None, **arrays: Tensor | None) -> dict[str, int]:
        """Check shapes and types of all declared inputs, which share the type and device of the first float.

        Returns:
            The size of each letter, `sizes` among them, which are known beforehand.

        Raises:
            TypeError: an argument that is not a tensor.
            ValueError: a wrong shape, dtype or device, or a gradient wanted by an input that has none.
            RuntimeError: an input carries a derivative in forward mode.
        """
        if transforms.in_forward_mode():
            transforms.refuse_forward_mode(self.name, arrays.values())
        sizes = {} if sizes is None else sizes
        batched = None
        for name, dims, batch, optional, hint in self._shapes:
            tensor = arrays[name]
            if tensor is None and optional:
                continue
            axes = tensor.ndim if isinstance(tensor, Tensor) else 0
            if batch == "*":
                batched = axes > len(dims) if batched is None else batched
                shape = ("B", *dims) if batched else dims
            else:
                shape = ("B", *dims) if batch == "?" and axes > len(dims) else dims
            if "P+Q" in shape:
                shape = tuple(sizes.get("P", 0) + sizes["Q"] if size == "P+Q" else size for size in shape)
            check_shape(name, tensor, *shape, sizes=sizes, hint=hint)
        like = None
        for name in self._floats:
            tensor = arrays[name]
            if tensor is not None:
                check_float(name, tensor, like)
                like = tensor if like is None else like
        for name in self._indices:
            check_device(name, arrays[name], like)
        refuse_gradient(self.name, **{name: arrays[name] for name in self._constant})
        return sizes


class Operator(Declaration):
    """A custom op, also known to torch as torch.ops.oasis_warp.`name`, that costs little where nothing traces it.

    Arguments come by position. The direct way gives no gradient to a tensor in a list: if one is needed, the call goes
    through torch.
    """

    def __init__(
        self,
        name: str,
        forward: Callable[..., Any],
        fake: Callable[..., Any],
        backward: Callable[..., Any] | None = None,
        fake_backward: Callable[..., Any] | None = None,
        *,
        inputs: Mapping[str, Array],
        outputs: Mapping[str, str],
        auxiliary: Mapping[str, str] = MappingProxyType({}),
        validates_itself: bool = False,
        caller: str = "",
        reference: str = "",
        public: bool = True,
    ) -> None:
        """Declare an operator and register it.

        Args:
            name: Name of the operator.
            forward: From tensors and numbers to fresh tensors that alias neither the inputs nor each other. Its
                annotations are the schema. Parameters with the names of `inputs` are those. If the last one is
                `validate` and true, float inputs that are not finite are refused beforehand.
            fake: From the same arguments to empty tensors of the shapes, types and strides that come out.
            backward: The adjoint. Its parameters have names, and stand in this order: those of inputs and results of
                `forward`, which are saved for it; those of numbers; g_NAME for the gradients by results, None for
                zeros; `needs`, a flag for each differentiable input. It returns a list with a gradient for each of
                them, an empty tensor where none is needed.
            fake_backward: From the same arguments to empty tensors. None: they have the shapes of the differentiable
                inputs, all of which are saved, and no rows where no gradient is needed.
            inputs: As in `Declaration`.
            outputs: Results that receive gradients.
            auxiliary: The other results, after these: for reading, or for the adjoint alone.
            validates_itself: `forward` looks at the values by itself.
            caller: Public function that messages name; `name` by default.
            reference: As in `Declaration`.
            public: As in `Declaration`.
        """
        super().__init__(name, inputs=inputs, outputs=outputs, reference=reference, public=public)
        self._parameters = list(parameters := inspect.signature(forward).parameters)
        self._tensors = [n for n, p in parameters.items() if p.annotation in (Tensor, Tensor | None)]
        checked = [(k, name) for k, name in enumerate(self._parameters) if name in self._floats]
        self.forward = forward
        self.caller = caller or name
        self._implementation = forward
        if self._parameters[-1] == "validate" and not validates_itself:
            self._implementation = _validating(forward, checked)
        described = {"mutates_args": (), "schema": transforms.schema_of(self._implementation)}
        self.custom_op = torch.library.custom_op(f"{NAMESPACE}::{name}", self._implementation, **described)
        self.custom_op.register_fake(fake)
        self._fake = fake
        self._traced = getattr(getattr(torch.ops, NAMESPACE), name).default
        self._differentiated: Callable[..., Any] = self._traced  # which raises, or keeps the refusal in the graph
        self._transformed = self._traced
        self._batched = [name in inputs and inputs[name].shape.startswith(BATCH) for name in self._parameters]
        self._wrt = [k for k, name in enumerate(self._parameters) if name in inputs and inputs[name].grad]
        if backward is not None:
            self._differentiate(backward, fake_backward, {**outputs, **auxiliary})

    def _differentiate(
        self,
        backward: Callable[..., Any],
        fake_backward: Callable[..., Any] | None,
        results: Mapping[str, str],
    ) -> None:
        """Register the adjoint, and what is saved for it."""
        places = {name: k for k, name in enumerate(self._parameters)}
        names, result_names = list(inspect.signature(backward).parameters), list(results)
        inputs = [n for n in names if n in self._tensors]
        saved = [n for n in names if n in results]
        numbers = [n for n in names if n in places and n not in self._tensors]
        incoming = [n for n in names if n.startswith("g_")]
        assert names == [*inputs, *saved, *numbers, *incoming, "needs"], f"{self.name}: parameters of the adjoint"
        shapes = {name: array.shape for name, array in self.inputs.items()} | dict(results)
        self._adjoint_batched = [shapes.get(n.removeprefix("g_"), "").startswith(BATCH) for n in names]
        if fake_backward is None:
            wrt = [names.index(self._parameters[k]) for k in self._wrt]
            fake_backward = lambda *arguments: empty_gradients([arguments[k] for k in wrt], arguments[-1])  # noqa: E731
        self.backward, self._fake_backward = backward, fake_backward
        self.adjoint = Operator(f"{self.name}_backward", backward, fake_backward, inputs={}, outputs={}, public=False)
        self.adjoint.custom_op.register_autograd(self._refuse)
        as_tuple = lambda *arguments: tuple(self.adjoint._traced(*arguments))  # noqa: E731
        self.adjoint._transformed = transforms.transformable(
            self.adjoint.name, self.caller, as_tuple, lambda *_: None, self._refuse
        )
        save, differentiate = _derivative(
            self.adjoint, len(places), self._wrt, [places[n] for n in inputs], [result_names.index(n) for n in saved],
            [places[n] for n in numbers], [result_names.index(n[2:]) for n in incoming],
            range(len(self.outputs), len(results)), self.caller,
        )  # fmt: skip
        self.custom_op.register_autograd(differentiate, setup_context=save)
        self._transformed = transforms.transformable(self.name, self.caller, self._traced, save, differentiate)
        implementation = self._implementation

        def run(ctx: Any, *arguments: Any) -> Any:
            output = implementation(*arguments)
            save(ctx, arguments, output)
            return output

        methods = {"forward": staticmethod(run), "backward": staticmethod(differentiate)}
        # Below Function.apply, which takes 3 us to look for functorch: `is_traced` has.
        self._differentiated = super(Function, type(self.name, (Function,), methods)).apply

    def _refuse(self, *_: Any) -> Any:
        raise RuntimeError(
            f"{self.caller}: expected one derivative, got a request for the second. "
            "It is differentiable once; detach the gradient before you go on with it."
        )

    def __call__(self, *arguments: Any) -> Any:
        """Run the op directly if possible, else through torch."""
        if transforms.in_forward_mode():
            transforms.refuse_forward_mode(self.caller, arguments)
        if is_traced():
            return self._transformed(*arguments) if transforms.in_transform() else self._traced(*arguments)
        tracks, needed = torch.is_grad_enabled(), False
        for argument in arguments:
            kind = type(argument)
            if kind is Tensor or kind is Parameter:
                if argument.is_neg():  # memory holds the opposite of what it stands for: the dispatcher resolves that
                    return self._through_torch(arguments)
                needed = needed or (tracks and argument.requires_grad)
            elif kind is list:
                for item in argument:
                    if type(item) is Tensor:
                        if item.is_neg() or (tracks and item.requires_grad):
                            return self._through_torch(arguments)
                    elif type(item) not in _NUMBERS:
                        return self._through_torch(arguments)
            elif kind not in _NUMBERS:  # a kind of tensor with its own way through ops, such as a fake one
                return self._through_torch(arguments)
        return self._differentiated(*arguments) if needed else self._implementation(*arguments)

    def _through_torch(self, arguments: Sequence[Any]) -> Any:
        check_kinds(self._parameters, arguments)
        return self._traced(*arguments)

    def each_pose(self, *arguments: Any) -> Any:
        """`forward` of several poses by an implementation that knows only one: pose after pose."""
        out = self._fake(*arguments)
        for k in range(self._n_poses(arguments, self._batched)):
            for whole, part in zip(out, self.forward(*_at_pose(arguments, self._batched, k)), strict=True):
                if whole.numel():
                    whole[k] = part
        return out

    def each_pose_backward(self, *arguments: Any) -> list[Tensor]:
        """`backward` of several poses, pose after pose; gradients of what all poses share are summed in order."""
        out = self._fake_backward(*arguments)
        shared = [not self._batched[k] for k in self._wrt]
        for gradient, summed in zip(out, shared, strict=True):
            if summed:
                gradient.zero_()
        for k in range(self._n_poses(arguments, self._adjoint_batched)):
            parts = self.backward(*_at_pose(arguments, self._adjoint_batched, k))
            for gradient, summed, part in zip(out, shared, parts, strict=True):
                if summed:
                    gradient += part
                elif gradient.numel():
                    gradient[k] = part
        return out

    @staticmethod
    def _n_poses(arguments: tuple[Any, ...], batched: list[bool]) -> int:
        return len(next(a for a, b in zip(arguments, batched, strict=True) if b and a is not None))


def _derivative(
    adjoint: Operator, n_inputs: int, wrt: Sequence[int], tensors: Sequence[int], results: Sequence[int],
    numbers: Sequence[int], incoming: Sequence[int], constant: Sequence[int], caller: str,
) -> tuple[Callable[..., None], Callable[..., Any]]:  # fmt: skip
    """The `setup_context` and `backward` of a forward op, given places among its arguments and results.

    A result that is a list of tensors comes last and is saved whole; it may hold opaque buffers.
    """

    def save(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:  # torch passes these names
        output = (output,) if isinstance(output, Tensor) else output
        saved, listed = [inputs[k] for k in tensors], None
        for k in results:
            if isinstance(output[k], Tensor):
                saved.append(output[k])
            else:
                listed = output[k]
        ctx.n_tensors, ctx.listed = len(saved), listed is not None
        ctx.bytes = None
        if listed is not None:
            saved += listed
            ctx.bytes = None if is_traced() else [t.untyped_storage().nbytes() for t in listed]
        ctx.save_for_backward(*saved)
        ctx.numbers = [inputs[k] for k in numbers]
        ctx.mark_non_differentiable(*(output[k] for k in constant if isinstance(output[k], Tensor)))
        ctx.set_materialize_grads(False)

    def differentiate(ctx: Any, *gradients: Any) -> tuple[Any, ...]:
        out: list[Tensor | None] = [None] * n_inputs
        given = [gradients[k] for k in incoming]
        if any(g is not None for g in given):
            saved = ctx.saved_tensors
            if ctx.listed:
                listed = list(saved[ctx.n_tensors :])
                if ctx.bytes is not None and ctx.bytes != [t.untyped_storage().nbytes() for t in listed]:
                    raise RuntimeError(
                        f"{caller}: expected the tensors that it saved, got copies, which lack what is hidden behind "
                        "them. Draw outside of hooks that move saved tensors, such as "
                        "torch.autograd.graph.save_on_cpu."
                    )
                saved = *saved[: ctx.n_tensors], listed
            needs = [ctx.needs_input_grad[k] for k in wrt]
            found = adjoint(*saved, *ctx.numbers, *given, needs)
            for k, needed, gradient in zip(wrt, needs, found, strict=True):
                if needed:
                    out[k] = gradient
        return tuple(out)

    return save, differentiate


_NUMBERS = frozenset({bool, int, float, type(None)})


def _at_pose(arguments: tuple[Any, ...], batched: list[bool], k: int) -> list[Any]:
    return [a[k] if b and a is not None else a for a, b in zip(arguments, batched, strict=True)]


def _validating(forward: Callable[..., Any], floats: list[tuple[int, str]]) -> Callable[..., Any]:
    """`forward` after a check of its float inputs, where `validate`, the last argument, is true."""

    @functools.wraps(forward)
    def run(*arguments: Any) -> Any:
        if arguments[-1]:
            check_finite(**{name: arguments[k] for k, name in floats})
        return forward(*arguments)

    return run


def empty_gradients(inputs: Sequence[Tensor | None], needs: Sequence[bool]) -> list[Tensor]:
    """Memory for the gradients by `inputs`: without rows where one is not needed, without elements for None."""
    like = next(tensor for tensor in inputs if tensor is not None)
    return [
        like.new_empty(0) if tensor is None else tensor.new_empty((len(tensor) if needed else 0, *tensor.shape[1:]))
        for tensor, needed in zip(inputs, needs, strict=True)
    ]


def needs_gradient(*tensors: Tensor | None) -> bool:
    """Whether torch will ask for a gradient by one of `tensors`: otherwise nothing need be saved for the adjoint."""
    return torch.is_grad_enabled() and any(t is not None and transforms.wants_gradient(t) for t in tensors)
