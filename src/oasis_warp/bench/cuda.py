"""Calls as CUDA graphs, and the kernels that they run, by torch's profiler."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch

from oasis_warp.bench.timing import Probe, device_clock
from oasis_warp.ops._runtime.pair_counts import Overflow, watch_overflow

GRAPH_CALLS = 10
"""Calls in the graph whose replays give the GPU time of one, so that the launch of the graph hardly counts."""
WARP_KERNEL = re.compile(r"(.+)_[0-9a-f]{8}_cuda_kernel_(forward|backward)")
"""What Warp makes of a kernel's name."""

Result = TypeVar("Result")


class NotCaptured(RuntimeError):
    """A call that no CUDA graph can hold, with torch's reason."""


@dataclass(frozen=True)
class Captured(Generic[Result]):
    """A CUDA graph and what its calls returned."""

    graph: Any
    calls: int
    results: Result
    """Of the last call, new after every replay."""
    overflow: Overflow
    """Whether a replay met more pairs of a Gaussian and a tile than the graph has memory for."""

    def probe(self) -> Probe:
        """Its replay, to time."""
        return Probe(self.graph.replay, device_clock, self.calls)


def capture(run: Callable[[], Result], calls: int = 1, warm_calls: int = 3) -> Captured[Result]:
    """A CUDA graph of calls of `run`.

    Args:
        run: Returns tensors without a history: one that is kept would keep nodes of torch's graph, and the stream they
            were made on, across calls.
        calls: In the graph.
        warm_calls: Before the capture, to load modules and to learn sizes.

    Raises:
        NotCaptured: it waits for the device, or does something else that no graph holds.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    # torch.cuda.graph does not give the stream back when a capture fails: the outer block does.
    with torch.cuda.stream(stream):
        for _ in range(warm_calls):
            run()
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        try:
            with watch_overflow() as overflow, torch.cuda.graph(graph, stream=stream):
                for _ in range(calls - 1):
                    run()
                results = run()
        except RuntimeError as error:
            raise NotCaptured(first_cause(error)) from error
    torch.cuda.current_stream().wait_stream(stream)
    graph.replay()
    torch.cuda.synchronize()
    return Captured(graph, calls, results, overflow)


def first_cause(error: BaseException) -> str:
    """The first line of the error that others followed from: a broken capture fails once more when it ends."""
    while error.__context__ is not None:
        error = error.__context__
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


@dataclass(frozen=True)
class KernelTime:
    """One kernel of a call."""

    name: str
    """Without what Warp adds to it, or the arguments and types of C++."""
    launches: float
    """In a call."""
    us: float
    """Of all its launches in a call, together."""


def short_name(name: str) -> str:
    """A kernel's name as its author wrote it."""
    warp = WARP_KERNEL.fullmatch(name)
    if warp:
        return warp[1] + (" (adjoint)" if warp[2] == "backward" else "")
    plain = name.removeprefix("void ").replace("(anonymous namespace)::", "")
    return re.split(r"[<(]", plain)[0].rpartition("::")[2].strip() or name


def add_up(events: Iterable[Any], calls: int) -> list[KernelTime]:
    """Kernels, copies and fills among the profiler's `events` of `calls` calls; the longest first."""
    found: dict[str, list[float]] = {}
    for event in events:
        if event.device_type == torch.autograd.DeviceType.CUDA:
            found.setdefault(short_name(event.name), []).append(event.time_range.elapsed_us())
    times = [KernelTime(name, len(us) / calls, sum(us) / calls) for name, us in found.items()]
    return sorted(times, key=lambda time: -time.us)


def kernel_times(run: Callable[[], object], calls: int = 20) -> list[KernelTime]:
    """The kernels of one call, the mean of `calls` calls after a few to warm up; empty where nothing can be traced."""
    for _ in range(calls):
        run()
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA], acc_events=True) as profile:
        for _ in range(calls):
            run()
        torch.cuda.synchronize()
    return add_up(profile.events() or [], calls)
