"""Functions captured as CUDA graphs: of a tuple of tensors, of a few small tensors, and the rasterizer under autograd.

An eager call is Python and many launches, which take the host longer than the work takes the device. A captured call
copies its arguments to the memory that the graph reads, and replays the graph. What a function reads besides its inputs
stays where it was when it was captured.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_warp.ops._runtime.pair_counts import watch_overflow
from oasis_warp.ops._runtime.values import ReplayedFiniteCheck, check_finite
from oasis_warp.ops.rasterization import rasterization

Result = TypeVar("Result")
Outputs = tuple[Tensor, ...]
MAX_GRAPHS = 8
"""Graphs that a cache keeps: each holds the memory of a whole picture."""
WARM_UPS = 2
"""Runs before the capture: the first loads kernels, fills caches and counts what a rasterization needs memory for, the
second makes plans."""


class CapturedCall(Generic[Result]):
    """A function that was captured once and is replayed for all inputs of the same shapes."""

    def __init__(self, function: Callable[[Any], Result], inputs: tuple[Tensor, ...], slack: float = 1.5):
        """Capture `function` without running it.

        Args:
            function: Has run before, which loads kernels, and never waits for the device. What it reads besides its
                inputs must stay at the same place in memory.
            inputs: A NamedTuple on a CUDA device, for the shapes.
            slack: Memory for the pairs of a rasterization, relative to what the last eager one needed.
        """
        self._inputs: Any = type(inputs)(*(tensor.clone() for tensor in inputs))
        self._graph = torch.cuda.CUDAGraph()
        with watch_overflow(slack) as self._overflow:
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._result = function(self._inputs)

    def __call__(self, inputs: tuple[Tensor, ...]) -> Result:
        """The result of the function for `inputs`; the next call overwrites its tensors."""
        torch._foreach_copy_(list[Tensor](self._inputs), list[Tensor](inputs))
        self._graph.replay()
        return self._result

    def lacked_memory(self) -> bool:
        """Whether images of the last call lack Gaussians because there were more pairs than memory.

        Call it after the device has finished the call.
        """
        return self._overflow.happened()


class _CapturedRasterization:
    """The forward and backward graph for arguments of the same shapes."""

    def __init__(self, arguments: tuple[Tensor, ...], width: int, height: int, options: dict[str, Any]) -> None:
        device = arguments[0].device
        self.needs = [tensor.requires_grad for tensor in arguments]
        self.inputs = [tensor.detach().clone().requires_grad_(tensor.requires_grad) for tensor in arguments]
        self._leaves = [tensor for tensor in self.inputs if tensor.requires_grad]

        def draw() -> tuple[Tensor, Tensor]:
            *scene, backgrounds = self.inputs
            return rasterization(*scene, width, height, backgrounds=backgrounds, validate=False, **options)[:2]

        def back(outputs: tuple[Tensor, Tensor]) -> tuple[Tensor | None, ...]:
            return torch.autograd.grad(outputs, self._leaves, self.incoming, allow_unused=True)

        with torch.inference_mode(False), torch.enable_grad(), torch.cuda.device(device):
            side_stream = torch.cuda.Stream()
            side_stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side_stream):
                for _ in range(WARM_UPS):
                    outputs = draw()
                    self.incoming = [torch.zeros_like(output) for output in outputs]
                    self._zero = [True for _ in outputs]
                    if self._leaves:
                        back(outputs)
            del outputs  # with the nodes that accumulate gradients on the side stream
            torch.cuda.current_stream().wait_stream(side_stream)
            self._forward, self._backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
            with watch_overflow() as self.overflow:
                with torch.cuda.graph(self._forward, capture_error_mode="thread_local"):
                    outputs = draw()
            if self._leaves:
                with torch.cuda.graph(self._backward, self._forward.pool(), capture_error_mode="thread_local"):
                    self._gradients = back(outputs)
        self.outputs = [output.detach() for output in outputs]

    def fits(self, arguments: tuple[Tensor, ...]) -> bool:
        """Whether the graphs are for arguments of these shapes, types and `requires_grad` flags."""
        return all(
            new.shape == captured.shape and new.dtype == captured.dtype and new.device == captured.device
            and new.requires_grad == needs
            for new, captured, needs in zip(arguments, self.inputs, self.needs, strict=True)
        )  # fmt: skip

    def draw(self, arguments: tuple[Tensor, ...]) -> bool:
        """Replay the forward graph; False if its memory did not suffice."""
        device = self.inputs[0].get_device()
        self.overflow.reset(device)
        with torch.no_grad():
            torch._foreach_copy_(self.inputs, list(arguments))
            self._forward.replay()
        self.overflow.wait(device)  # only then is it known whether the image is whole
        return not self.overflow.happened()

    def back(self, incoming: tuple[Tensor | None, Tensor | None]) -> list[Tensor | None]:
        """Replay the backward graph: one gradient for each argument, None where it needs none."""
        for k, gradient in enumerate(incoming):
            if gradient is not None:
                self.incoming[k].copy_(gradient)
            elif not self._zero[k]:
                self.incoming[k].zero_()
            self._zero[k] = gradient is None
        self._backward.replay()
        gradients = iter(self._gradients)
        found = [next(gradients) if needs else None for needs in self.needs]
        return [None if g is None else g.detach() for g in found]


class _Replay(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, captured: _CapturedRasterization, *_: Tensor) -> tuple[Tensor, ...]:
        ctx.captured = captured
        ctx.set_materialize_grads(False)
        return tuple(output.detach() for output in captured.outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple[Any, ...]:
        return None, *ctx.captured.back(incoming)


class RecordedRasterization:
    """`rasterization` for images of one size on CUDA, captured at the first call and replayed by the others.

    For training from Python, where an eager call waits for Python. Results have the bits of `rasterization`. They lie
    in memory of the graphs, as do the gradients: the next call overwrites both, so use or copy them first, and call
    backward before you draw again. Other shapes, or other arguments that need a gradient, are captured anew. So is a
    call with more pairs of a Gaussian and a tile than the graph has memory for, after it was drawn eagerly.
    """

    def __init__(self, width: int, height: int, **options: Any) -> None:
        """Nothing is captured yet.

        Args:
            width: Width of the images [px].
            height: Height of the images [px].
            options: Arguments of `rasterization` that are not tensors, except `validate`.
        """
        self._size = width, height
        self._options = options
        self._captured: _CapturedRasterization | None = None

    def __call__(
        self,
        means: Float[Tensor, "N 3"],
        quats: Float[Tensor, "N 4"],
        scales: Float[Tensor, "N 3"],
        opacities: Float[Tensor, "N"],
        colors: Float[Tensor, "N D"] | Float[Tensor, "C N D"] | Float[Tensor, "N K 3"] | Float[Tensor, "C N K 3"],
        viewmats: Float[Tensor, "C 4 4"],
        Ks: Float[Tensor, "C 3 3"],
        backgrounds: Float[Tensor, "C D"],
    ) -> tuple[Float[Tensor, "C H W X"], Float[Tensor, "C H W 1"]]:
        """Images and alpha, as `rasterization` draws them with `validate=False`.

        Raises:
            ValueError: shapes, types or devices that do not belong together, or not float32 on CUDA.
        """
        arguments = means, quats, scales, opacities, colors, viewmats, Ks, backgrounds
        captured = self._captured
        if captured is None or not captured.fits(arguments):
            if not (means.is_cuda and means.dtype == torch.float32):
                raise ValueError(
                    f"means: expected float32 on a CUDA device, got {means.dtype} on {means.device}. "
                    "Elsewhere call rasterization, which has nothing to record."
                )
            captured = self._captured = _CapturedRasterization(arguments, *self._size, self._options)
        if not captured.draw(arguments):
            self._captured = None
            *scene, backgrounds = arguments
            return rasterization(*scene, *self._size, backgrounds=backgrounds, validate=False, **self._options)[:2]
        image, alphas = _Replay.apply(captured, *arguments)
        return image, alphas


def replayable(device: torch.device, inputs: Sequence[Tensor]) -> bool:
    """Whether a call may be replayed: on CUDA, without a gradient, and not itself part of a graph."""
    if device.type != "cuda" or torch.compiler.is_compiling() or torch.cuda.is_current_stream_capturing():
        return False
    return not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs))


class CapturedGraph:
    """A function as a CUDA graph."""

    def __init__(self, function: Callable[..., Outputs], inputs: Sequence[Tensor], like: Tensor, checked: int = 0):
        """Run `function` to warm it up, then record it.

        Args:
            function: From tensors of the shapes of `inputs` to its outputs. While it is recorded it waits for nothing
                and copies nothing from the host.
            inputs: A first set of arguments.
            like: A tensor of the device and precision that `function` gets them in.
            checked: How many inputs, the first ones, are looked at whenever it runs: see `bad`.
        """
        self._graph = torch.cuda.CUDAGraph()
        # What is made here is written to in any mode; and a graph belongs to the current device.
        with torch.cuda.device(like.device), torch.inference_mode(False), torch.no_grad():
            self._allocate(inputs, like)
            self._check = ReplayedFiniteCheck(self._flat[: sum(tensor.numel() for tensor in inputs[:checked])])
            self._fill(inputs)
            self._record(function)

    def _allocate(self, inputs: Sequence[Tensor], like: Tensor) -> None:
        """One block of memory on the device for all inputs, and a page-locked one that is sent there."""
        sizes = [tensor.numel() for tensor in inputs]

        def shares(flat: Tensor) -> list[Tensor]:
            return [part.view(t.shape) for part, t in zip(flat.split(sizes), inputs, strict=True)]

        self._flat = torch.empty(sum(sizes), dtype=like.dtype, device=like.device)
        self._inputs = shares(self._flat)
        self._staged = torch.empty(sum(sizes), dtype=like.dtype, pin_memory=True)
        self._staged_inputs = shares(self._staged)

    def _record(self, function: Callable[..., Outputs]) -> None:
        here, aside = torch.cuda.current_stream(), torch.cuda.Stream()
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            self._check.check()
            for _ in range(WARM_UPS):
                function(*self._inputs)
        here.wait_stream(aside)
        with watch_overflow() as self._overflow:
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._check.check()
                self._outputs = function(*self._inputs)

    def _fill(self, inputs: Sequence[Tensor]) -> None:
        """Put `inputs`, from wherever they are, in their places."""
        for place, tensor in zip(self._staged_inputs, inputs, strict=True):
            if not tensor.is_cuda:
                place.copy_(tensor)
        if not all(tensor.is_cuda for tensor in inputs):
            self._flat.copy_(self._staged, non_blocking=True)
        near = [(place, tensor) for place, tensor in zip(self._inputs, inputs, strict=True) if tensor.is_cuda]
        if near:
            torch._foreach_copy_(*map(list, zip(*near, strict=True)))

    def bad(self) -> bool:
        """Whether one of the `checked` inputs of the last call was not finite or absurdly large."""
        return self._check.bad()

    def __call__(self, inputs: Sequence[Tensor]) -> Outputs | None:
        """The function's outputs, in fresh memory; None where that for its rasterizations did not suffice.

        Where it draws, the call returns before the pictures are done, like any on CUDA.
        """
        if torch.is_inference_mode_enabled() or torch.cuda.current_device() != self._flat.get_device():
            with torch.cuda.device(self._flat.device), torch.inference_mode(False):
                return self(inputs)
        device = self._flat.get_device()
        self._overflow.reset(device)
        self._check.reset()
        with torch.no_grad():
            self._fill(inputs)
            self._graph.replay()
            outputs = tuple(output.clone() for output in self._outputs)
        self._overflow.wait(device)  # only then is it known whether the picture is whole
        return None if self._overflow.happened() else outputs


class GraphCache:
    """The most recently used recorded functions, by key."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        """Held while one of them is in use: they are one caller's at a time."""
        self._kept: OrderedDict[Hashable, Callable[[Sequence[Tensor]], Outputs | None]] = OrderedDict()

    def __reduce__(self) -> tuple[type["GraphCache"], tuple[()]]:
        return GraphCache, ()  # a copy of what they belong to starts without any

    def find(
        self, key: Hashable, record: Callable[[], Callable[[Sequence[Tensor]], Outputs | None]]
    ) -> Callable[[Sequence[Tensor]], Outputs | None]:
        """The recording of `key`, made by `record` if there is none; the least recently used one is dropped."""
        if key not in self._kept:
            self._kept[key] = record()
            while len(self._kept) > MAX_GRAPHS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def forget(self, key: Hashable) -> None:
        """The next call records anew."""
        self._kept.pop(key, None)


def replayed(
    recordings: GraphCache,
    key: Hashable,
    record: Callable[[], Callable[[Sequence[Tensor]], Outputs | None]],
    exact: Callable[..., Outputs],
    inputs: Sequence[Tensor],
    names: Sequence[str] = (),
) -> Outputs:
    """What a recorded function makes of `inputs`; where its memory did not suffice, what `exact` makes of them.

    Args:
        recordings: Where recordings are kept.
        key: What the function depends on besides the values of `inputs`: sizes and precision.
        record: Makes a `CapturedGraph`, if there is none under `key` or the last one's memory did not suffice.
        exact: The function itself.
        inputs: Small tensors, on any device.
        names: Names of the inputs that `CapturedGraph` has `checked`, to look at their values.

    Raises:
        ValueError: an input with a name is not finite.
    """
    with recordings.lock:
        recording = recordings.find(key, record)
        outputs = recording(inputs)
        if names and isinstance(recording, CapturedGraph) and recording.bad():
            check_finite(**dict(zip(names, inputs, strict=False)))
        if outputs is not None:
            return outputs
        recordings.forget(key)
    return exact(*inputs)
