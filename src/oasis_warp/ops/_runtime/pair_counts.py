"""Memory for the pairs of a Gaussian and a tile in a CUDA rasterization.

An eager call waits for their count, the only point at which the host waits for the device, and allocates exactly that
much. A call that a CUDA graph captures cannot wait: it allocates what the last eager call of its kind needed, and some
more. If a replay needs more, lists that do not fit stay empty, and `Overflow.happened` returns True.
"""

import ctypes
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_kernels.rasterize.tiles_cuda import LONGEST, REPORT, RUN
from oasis_warp.ops._runtime.blend_tiles import MAX_PAIRS

PAGE = 4096
"""Words of host memory per allocation for reports."""


SORTED = LONGEST, RUN, MAX_PAIRS
"""Lengths of a tile's list up to which one way of sorting does."""
SPINS = 2000
"""Looks at words that the device is about to write, some 0.1 ms, before the thread sleeps."""


class Counts(NamedTuple):
    """What a call needs or has memory for."""

    pairs: int
    longest: int
    """Length of the longest list of a tile, or of the longest that can be sorted."""


Kind = tuple[torch.device, int, int, int, int]
"""Device, cameras, Gaussians, width, height."""
_last: dict[Kind, Counts] = {}


class _Slots:
    """Page-locked host memory that kernels write to, in slots of `REPORT` words."""

    def __init__(self) -> None:
        self.free: list[Tensor] = []
        self.lock = threading.Lock()

    def take(self) -> Tensor:
        with self.lock:
            if not self.free:
                page = torch.zeros(PAGE, dtype=torch.int64, pin_memory=True)
                self.free = list(page[: PAGE // REPORT * REPORT].split(REPORT))
            return self.free.pop()

    def reserve(self) -> None:
        """Keep a slot ready: during a capture no memory can be page-locked."""
        if not self.free:
            self.release(self.take())

    def release(self, slot: Tensor) -> None:
        with self.lock:
            self.free.append(slot)


slots = _Slots()
"""For kernels that report a few numbers to the host."""


class _ThreadSlot(threading.local):
    """One slot per thread, for calls that wait."""

    def __init__(self) -> None:
        self.slot = slots.take()
        weakref.finalize(threading.current_thread(), slots.release, self.slot)


_thread_slot: _ThreadSlot | None = None
_slot_lock = threading.Lock()


def thread_slot() -> Tensor:
    """This thread's host memory [REPORT], int64, for a call that waits for the device."""
    global _thread_slot
    with _slot_lock:
        if _thread_slot is None:  # not at import: page-locked memory needs a device
            _thread_slot = _ThreadSlot()
    return _thread_slot.slot


class PolledCounters:
    """Page-locked words that kernels write and the host looks at while later kernels still run."""

    def __init__(self, count: int) -> None:
        self._memory = torch.zeros(count, dtype=torch.int64, pin_memory=True)
        self.address = self._memory.data_ptr()
        self.values = (ctypes.c_longlong * count).from_address(self.address)

    def wait(self, device: int) -> None:
        """Wait until the first two, which were made negative before, are not; or until the current stream is done."""
        _poll(self.values, device)


def _poll(values: Any, device: int) -> None:
    for _ in range(SPINS):
        if values[0] >= 0 and values[1] >= 0:
            return
    torch.cuda.current_stream(device).synchronize()


class Overflow:
    """Whether watched graphs have met more pairs than they have memory for."""

    def __init__(self, slack: float) -> None:
        self._slack = slack
        self._reports: list[tuple[Tensor, Any, Counts]] = []
        self._stream: torch.cuda.Stream | None = None

    def expect(self, kind: Kind) -> tuple[Tensor, Counts]:
        """Memory for the report, and the capacity, of a captured call of this `kind`."""
        # The slot stays the graph's: it may be replayed after the watch has ended.
        slot, capacity = slots.take().zero_(), capacity_of(kind, self._slack)
        self._reports.append((slot, (ctypes.c_longlong * REPORT).from_address(slot.data_ptr()), capacity))
        return slot, capacity

    def reset(self, device: int) -> None:
        """Expect the reports of the next replay, on the current stream, after the last one on any."""
        for _, counters, _ in self._reports:
            counters[0] = counters[1] = -1
        if self._stream is None or torch._C._cuda_getCurrentRawStream(device) != self._stream.cuda_stream:
            here = torch.cuda.current_stream(device)
            if self._stream is not None:
                here.wait_stream(self._stream)
            self._stream = here

    def wait(self, device: int) -> None:
        """Wait for the reports of a replay on the current stream, which come before its pictures; `reset` it before.

        All that the replay does before its last rasterization has then been done; without one, all that it does.
        """
        for _, counters, _ in self._reports:
            _poll(counters, device)
        if not self._reports:
            torch.cuda.current_stream(device).synchronize()

    def happened(self) -> bool:
        """Whether the last replay overflowed; wait for it first (`wait`, or `torch.cuda.synchronize`).

        If so, call eagerly once and capture again.
        """
        return any(
            counters[0] > capacity.pairs or counters[1] > capacity.longest for _, counters, capacity in self._reports
        )


_watching: ContextVar[Overflow | None] = ContextVar("watching", default=None)


@contextmanager
def watch_overflow(slack: float = 1.5) -> Iterator[Overflow]:
    """Watch the rasterizations that a CUDA graph captures inside the block.

    A captured call of `rasterization` has memory for `slack` times as many pairs of a Gaussian and a tile as the last
    eager call with the same device, numbers of cameras and Gaussians, and size. After a replay that needed more, the
    image lacks Gaussians and `Overflow.happened()` is true. A capture outside such a block is refused, because it would
    go unnoticed.
    """
    overflow = Overflow(slack)
    token = _watching.set(overflow)
    try:
        yield overflow
    finally:
        _watching.reset(token)


def capacity_of(kind: Kind, slack: float) -> Counts:
    """Memory for a captured call; refuses one without an eager call of its kind before."""
    if kind not in _last:
        device, n_cameras, n, width, height = kind
        raise RuntimeError(
            f"rasterization: expected an eager call before it is captured in a CUDA graph, got none with {n_cameras} "
            f"cameras of {width} x {height} px and {n} Gaussians on {device}. Warm up with the same sizes."
        )
    last = _last[kind]
    longest = int(slack * last.longest)
    sorted_ = next(limit for limit in SORTED if limit >= longest)
    return Counts(min(int(slack * last.pairs) + 4096, MAX_PAIRS), sorted_)


def watching() -> Overflow:
    """The `Overflow` that watches this capture; refuses a capture without one."""
    overflow = _watching.get()
    if overflow is None:
        raise RuntimeError(
            "rasterization: expected a capture inside `with watch_overflow() as overflow`, got one outside. "
            "Pictures of a graph are whole only while overflow.happened() is false."
        )
    return overflow


def remember(kind: Kind, counts: Counts) -> None:
    """Record the needs of an eager call for graphs of the same kind."""
    _last[kind] = counts
    slots.reserve()
