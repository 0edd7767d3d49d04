"""Repeat a function of a few small tensors as a CUDA graph: one copy in, one launch, and copies out.

What the function reads besides its inputs, models and avatars, stays where it was when it was recorded.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor

Outputs = tuple[Tensor, ...]
MOST = 8
"""Recordings that are kept: each holds the memory of a whole frame."""
SLOTS = 4
"""Calls whose inputs may be on their way to the device at once."""


def replayable(device: torch.device, inputs: Sequence[Tensor]) -> bool:
    """Whether a call may be replayed: on CUDA, without a gradient, and not itself part of a graph."""
    if device.type != "cuda" or torch.compiler.is_compiling() or torch.cuda.is_current_stream_capturing():
        return False
    return not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs))


class Recording:
    """A function as a CUDA graph."""

    def __init__(
        self, function: Callable[..., tuple[Outputs, Tensor | None]], inputs: Sequence[Tensor], like: Tensor
    ):
        """Run `function` to warm it up, then record it.

        Args:
            function: From tensors of the shapes of `inputs` to its outputs and, where their memory may not suffice, one
                whole number on the device that is 0 if it did. It waits for nothing and copies nothing from the host,
                at least from its second call on.
            inputs: A first set of arguments.
            like: A tensor of the device and precision that `function` gets them in.
        """
        self._sent = [torch.cuda.Event() for _ in range(SLOTS)]
        self._next = 0
        self._read = torch.cuda.Event()
        self._graph = torch.cuda.CUDAGraph()
        with torch.inference_mode(False), torch.no_grad():  # what is made here is written to in any mode
            self._allocate(inputs, like)
            self._fill(inputs)
            self._record(function)
            if self._overflow is not None:
                self._verdict = torch.zeros(1, dtype=self._overflow.dtype, pin_memory=True)

    def _allocate(self, inputs: Sequence[Tensor], like: Tensor) -> None:
        """One block of memory on the device for all inputs, and several pinned ones that are sent there."""
        sizes = [tensor.numel() for tensor in inputs]

        def shares(flat: Tensor) -> list[Tensor]:
            return [part.view(t.shape) for part, t in zip(flat.split(sizes), inputs, strict=True)]

        self._flat = torch.empty(sum(sizes), dtype=like.dtype, device=like.device)
        self._inputs = shares(self._flat)
        self._staged = torch.empty(SLOTS, sum(sizes), dtype=like.dtype, pin_memory=True)
        self._slots = [shares(row) for row in self._staged]

    def _record(self, function: Callable[..., tuple[Outputs, Tensor | None]]) -> None:
        here, aside = torch.cuda.current_stream(self._flat.device), torch.cuda.Stream(self._flat.device)
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            for _ in range(2):  # loads modules and fills caches; then as it will be recorded
                function(*self._inputs)
        here.wait_stream(aside)
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._outputs, self._overflow = function(*self._inputs)

    def _fill(self, inputs: Sequence[Tensor]) -> None:
        """Put `inputs`, from wherever they are, in their places."""
        away = [not tensor.is_cuda for tensor in inputs]
        if any(away):
            slot, sent = self._next, self._sent[self._next]
            self._next = (slot + 1) % SLOTS
            sent.synchronize()  # nothing to wait for, unless the device is `SLOTS` calls behind
            for place, tensor, here in zip(self._slots[slot], inputs, away, strict=True):
                if here:
                    place.copy_(tensor)
            self._flat.copy_(self._staged[slot], non_blocking=True)
            sent.record()
        for place, tensor, here in zip(self._inputs, inputs, away, strict=True):
            if not here:
                place.copy_(tensor)

    def __call__(self, inputs: Sequence[Tensor]) -> Outputs | None:
        """The function's outputs, in fresh memory; None where its own did not suffice."""
        stream = torch.cuda.current_stream(self._flat.device)
        stream.wait_event(self._read)  # of the call before, perhaps on another stream
        with torch.inference_mode(False), torch.no_grad():
            self._fill(inputs)
            self._graph.replay()
            outputs = tuple(output.clone() for output in self._outputs)
            if self._overflow is not None:
                self._verdict.copy_(self._overflow.view(1), non_blocking=True)
        self._read.record(stream)
        if self._overflow is not None:
            self._read.synchronize()
            if self._verdict.item():
                return None
        return outputs


class Recordings:
    """The last few functions that were recorded, by what tells them apart."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        """Held while one of them is in use: they are one caller's at a time."""
        self._kept: OrderedDict[Hashable, Callable[[Sequence[Tensor]], Outputs | None]] = OrderedDict()

    def find(
        self, key: Hashable, record: Callable[[], Callable[[Sequence[Tensor]], Outputs | None]]
    ) -> Callable[[Sequence[Tensor]], Outputs | None]:
        """The recording of `key`, made by `record` if there is none; the one unused for longest makes room."""
        if key not in self._kept:
            self._kept[key] = record()
            while len(self._kept) > MOST:  # only now: recording has waited for the device, which may still have used it
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def forget(self, key: Hashable) -> None:
        """The next call records anew."""
        self._kept.pop(key, None)


def replayed(
    recordings: Recordings,
    key: Hashable,
    record: Callable[[], Callable[[Sequence[Tensor]], Outputs | None]],
    exact: Callable[..., Outputs],
    inputs: Sequence[Tensor],
) -> Outputs:
    """What a recorded function makes of `inputs`; where its memory did not suffice, what `exact` makes of them.

    Args:
        recordings: Where recordings are kept.
        key: What the function depends on besides the values of `inputs`: sizes and precision.
        record: Makes a `Recording`, if there is none under `key` or the last one's memory did not suffice.
        exact: The same function with all the memory that it takes.
        inputs: Small tensors, on any device.
    """
    with recordings.lock:
        outputs = recordings.find(key, record)(inputs)
        if outputs is not None:
            return outputs
        recordings.forget(key)
    return exact(*inputs)
