"""Time calls that a GPU finishes later: on the host's clock, and as CUDA graphs on the GPU's own.

A call's wall time is what the host takes for many calls in a row and one wait at the end. Its GPU time is that of a
CUDA graph with ten calls in it, replayed back to back between two events: no host, and hardly any launch, is in it.
Both run on the CPU too, where there are no graphs and so no GPU time.
"""

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch

from oasis_warp.bench.timing import synchronise
from oasis_warp.ops._runtime.pair_counts import Overflow, watch_overflow

STEPS_A_GRAPH = 10
"""Calls in the graph whose replays give the GPU time of one, so that the launch of the graph hardly counts."""
WARM_CALLS = 20
"""Calls before anything is timed: an idle H200 runs at a sixth of its working clock."""
WARM_SECONDS = 0.05
"""Least time of these calls, as long as they are not over `LONGEST_WARM`."""
LONGEST_WARM = 0.3
GROUP_SECONDS = 0.01
"""What a group of calls shall last: the wait at its end, of some ten microseconds, is a thousandth of it."""
MOST_CALLS = 1000
"""In a group."""

Clock = Callable[[Callable[[], object], int], float]
"""From a call and how often to make it to the milliseconds of all of them."""
Result = TypeVar("Result")


def host_clock(run: Callable[[], object], times: int) -> float:
    """Wall time of `times` calls with one wait at the end [ms]."""
    synchronise()
    start = time.perf_counter()
    for _ in range(times):
        run()
    synchronise()
    return 1e3 * (time.perf_counter() - start)


def device_clock(run: Callable[[], object], times: int) -> float:
    """Time between CUDA events around `times` calls [ms]: the GPU's own, as long as the host keeps ahead of it."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    for _ in range(times):
        run()
    end.record()
    end.synchronize()
    return start.elapsed_time(end)


@dataclass(frozen=True)
class Probe:
    """Something to be timed."""

    run: Callable[[], object]
    clock: Clock = host_clock
    steps: int = 1
    """How often one call does what the time is given for."""


@dataclass(frozen=True)
class Sample:
    """Milliseconds of one step, a value a group."""

    times_ms: tuple[float, ...]
    calls: int
    """In each group."""

    @property
    def median_ms(self) -> float:
        """That of the group in the middle."""
        return statistics.median(self.times_ms)

    @property
    def iqr_ms(self) -> float:
        """Distance of the quartiles."""
        low, _, high = statistics.quantiles(self.times_ms, n=4)
        return high - low


def time_groups(probes: Sequence[Probe], groups: int, seconds: float | None = None) -> list[Sample]:
    """Time groups of calls, the probes taking turns, so that a machine that gets slower does so for all of them.

    Args:
        probes: What to time; each is warmed up first.
        groups: Of each probe; at least 2. Every round begins with another probe.
        seconds: What all groups together may last: slow calls are made once a group, and in fewer groups.
    """
    if groups < 2:
        raise ValueError(f"groups: expected 2 or more, got {groups}. Quartiles need some.")
    longest = [warm_up(probe) for probe in probes]
    calls = [max(1, min(MOST_CALLS, round(1e3 * GROUP_SECONDS / ms))) for ms in longest]
    if seconds is not None:
        a_round = 1e-3 * sum((n + 1) * ms for n, ms in zip(calls, longest, strict=True))
        groups = max(2, min(groups, int(seconds / a_round)))
    times: list[list[float]] = [[] for _ in probes]
    collecting = gc.isenabled()
    gc.disable()
    gc.freeze()  # what is there already is not looked through in every round
    try:
        for done in range(groups):
            for place in range(len(probes)):
                k = (place + done) % len(probes)
                probes[k].run()  # the one before it left its own data in the caches
                times[k].append(probes[k].clock(probes[k].run, calls[k]) / (calls[k] * probes[k].steps))
            gc.collect()
    finally:
        gc.unfreeze()
        if collecting:
            gc.enable()
    return [Sample(tuple(t), n) for t, n in zip(times, calls, strict=True)]


def warm_up(probe: Probe) -> float:
    """Milliseconds of one of the last calls, after enough of them for the clocks to rise."""
    probe.clock(probe.run, 1)  # compiles or loads kernels
    done, spent = 0, 0.0
    while True:
        calls = 1 + done
        ms = probe.clock(probe.run, calls)
        done, spent = done + calls, spent + 1e-3 * ms
        if spent >= LONGEST_WARM or (done >= WARM_CALLS and spent >= WARM_SECONDS):
            return ms / calls


class NotCaptured(RuntimeError):
    """A call that no CUDA graph can hold; says what torch said."""


@dataclass(frozen=True)
class Captured(Generic[Result]):
    """A CUDA graph and what its calls returned."""

    graph: Any
    steps: int
    results: Result
    """Of the last call, new after every replay."""
    overflow: Overflow
    """Whether a replay met more pairs of a Gaussian and a tile than the graph has memory for."""

    def probe(self) -> Probe:
        """Its replay, to be timed."""
        return Probe(self.graph.replay, device_clock, self.steps)


def capture(run: Callable[[], Result], steps: int = 1, warm_calls: int = 3) -> Captured[Result]:
    """`steps` calls of `run` as a CUDA graph.

    Args:
        run: Returns tensors without a history: one that is kept would keep nodes of torch's graph, and the stream they
            were made on, across calls.
        steps: Calls in the graph.
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
                for _ in range(steps - 1):
                    run()
                results = run()
        except RuntimeError as error:
            raise NotCaptured(first_cause(error)) from error
    torch.cuda.current_stream().wait_stream(stream)
    graph.replay()
    torch.cuda.synchronize()
    return Captured(graph, steps, results, overflow)


def first_cause(error: BaseException) -> str:
    """The first line of the error that others followed from: a broken capture fails once more when it ends."""
    while error.__context__ is not None:
        error = error.__context__
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
