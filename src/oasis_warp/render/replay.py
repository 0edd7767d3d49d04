"""Replay a function of a few small tensors as a CUDA graph: one copy in, one launch, and copies out.

What the function reads besides its inputs, models and avatars, stays where it was when it was recorded.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor

from oasis_warp.ops import ReplayedFiniteCheck, check_finite, watch_overflow

Outputs = tuple[Tensor, ...]
MAX_GRAPHS = 8
"""Graphs that a cache keeps: each holds the memory of a whole picture."""
WARM_UPS = 2
"""Runs before the capture: the first loads kernels, fills caches and counts what a rasterization needs memory for, the
second makes plans."""


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
        names: Of the inputs that `CapturedGraph` has `checked`, to look at their values.

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
