"""Time calls side by side, as CUDA graphs too; how much memory they take, and which kernels, by torch's profiler.

`time_together` takes the wall and CPU time of single synchronised calls. `time_groups` is for work that a GPU finishes
later: a call's wall time is what the host takes for many calls in a row and one wait at the end, and its GPU time that
of a CUDA graph with ten calls in it, replayed back to back between two events: without the host, and with hardly any
launch. Both run on the CPU too, where there are no graphs and so no GPU time.
"""

import ctypes
import gc
import os
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch

from oasis_warp.core.processes import using_threads
from oasis_warp.ops._runtime.pair_counts import Overflow, watch_overflow

SLOW_MS = 100.0
"""Calls from here on are not repeated for warm caches: those of their own data are cold anyway."""
WARM_CALLS = 20
"""Calls before groups are timed: an idle H200 runs at a sixth of its working clock."""
WARM_SECONDS = 0.05
"""Least time of these calls, unless they take longer than `LONGEST_WARM`."""
LONGEST_WARM = 0.3
GROUP_SECONDS = 0.01
"""Duration of a group of calls: the wait at its end, of some ten microseconds, is a thousandth of it."""
MAX_CALLS = 1000
"""In a group."""
YARDSTICK_MATRIX, YARDSTICK_FLOATS = 512, 2**20

Clock = Callable[[Callable[[], object], int], float]
"""From a call and how often to make it to the milliseconds of all of them."""
GRAPH_CALLS = 10
"""Calls in the graph whose replays give the GPU time of one, so that the launch of the graph hardly counts."""
WARP_KERNEL = re.compile(r"(.+)_[0-9a-f]{8}_cuda_kernel_(forward|backward)")
"""What Warp makes of a kernel's name."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class Sample:
    """Milliseconds of one call, a value for each group of calls."""

    times_ms: tuple[float, ...]
    calls: int = 1
    """In each group."""

    @property
    def median_ms(self) -> float:
        """Median of the groups."""
        return statistics.median(self.times_ms)

    @property
    def iqr_ms(self) -> float:
        """Interquartile range."""
        low, _, high = statistics.quantiles(self.times_ms, n=4)
        return high - low


@dataclass(frozen=True, kw_only=True)
class Timing(Sample):
    """Wall times of single synchronised calls, and the CPU times of the process in them."""

    first_ms: float
    """The first call, with compiling or loading its kernels."""
    cpu_times_ms: tuple[float, ...]

    @property
    def fastest_ms(self) -> float:
        """The fastest call."""
        return min(self.times_ms)

    @property
    def cpu_ms(self) -> float:
        """Least CPU time of all threads together, which waiting for other work does not inflate."""
        return min(self.cpu_times_ms)


@dataclass(frozen=True)
class Timed:
    """One call to time."""

    run: Callable[[], object]
    threads: int
    """CPU threads that torch and our kernels may use."""
    around: Callable[[], AbstractContextManager[object]] = nullcontext
    """A context for the call; its own time does not count."""

    @contextmanager
    def ready(self) -> Iterator[None]:
        """Set up threads and context inside the block."""
        with using_threads(self.threads), self.around():
            yield


def synchronise() -> None:
    """Wait for the GPU, if one is in use."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()


def milliseconds(run: Callable[[], object]) -> tuple[float, float]:
    """Wall and CPU time of one call."""
    synchronise()
    start, start_cpu = time.perf_counter(), time.process_time()
    run()
    synchronise()
    end, end_cpu = time.perf_counter(), time.process_time()
    return 1e3 * (end - start), 1e3 * (end_cpu - start_cpu)


def in_turns(n: int, rounds: int, after_round: Callable[[int], object] | None = None) -> Iterator[int]:
    """Indices 0 .. n - 1 in each of `rounds`, each round beginning with another one; garbage is collected in between.

    A machine that gets slower does so for all that take turns.
    """
    collecting = gc.isenabled()
    gc.disable()
    gc.freeze()  # existing objects are not searched in every round
    try:
        for done in range(rounds):
            for k in range(n):
                yield (k + done) % n
            gc.collect()
            if after_round is not None:
                after_round(done + 1)
    finally:
        gc.unfreeze()
        if collecting:
            gc.enable()


def time_together(
    calls: Sequence[Timed], repeats: int, after_round: Callable[[int], object] | None = None
) -> list[Timing]:
    """Time calls in turns.

    Every call is warmed up. Each round runs each call twice in a row: the first run fetches its data into the caches,
    the second is timed.

    Args:
        calls: What to time.
        repeats: Rounds, at least 2.
        after_round: Called with the number of finished rounds.
    """
    if repeats < 2:
        raise ValueError(f"repeats: expected 2 or more, got {repeats}.")
    first, warm = [], []
    times: list[list[tuple[float, float]]] = [[] for _ in calls]
    for call in calls:
        with call.ready():
            first.append(milliseconds(call.run)[0])
            warm.append(milliseconds(call.run)[0])
    for k in in_turns(len(calls), repeats, after_round):
        with calls[k].ready():
            if warm[k] < SLOW_MS:
                calls[k].run()
            times[k].append(milliseconds(calls[k].run))
    walls_and_cpus = [zip(*t, strict=True) for t in times]
    return [Timing(wall, first_ms=f, cpu_times_ms=cpu) for f, (wall, cpu) in zip(first, walls_and_cpus, strict=True)]


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
    """One call to time in groups."""

    run: Callable[[], object]
    clock: Clock = host_clock
    steps: int = 1
    """How often one call does what the time is given for."""


def time_groups(probes: Sequence[Probe], groups: int, seconds: float | None = None) -> list[Sample]:
    """Time groups of calls, the probes taking turns.

    Args:
        probes: What to time; each is warmed up first.
        groups: Groups of calls of each probe; at least 2.
        seconds: Limit for all groups together: slow calls are made once a group, and in fewer groups.
    """
    if groups < 2:
        raise ValueError(f"groups: expected 2 or more, got {groups}. Quartiles need some.")
    longest = [warm_up(probe) for probe in probes]
    calls = [max(1, min(MAX_CALLS, round(1e3 * GROUP_SECONDS / ms))) for ms in longest]
    if seconds is not None:
        a_round = 1e-3 * sum((n + 1) * ms for n, ms in zip(calls, longest, strict=True))
        groups = max(2, min(groups, int(seconds / a_round)))
    times: list[list[float]] = [[] for _ in probes]
    for k in in_turns(len(probes), groups):
        probes[k].run()  # the one before it left its own data in the caches
        times[k].append(probes[k].clock(probes[k].run, calls[k]) / (calls[k] * probes[k].steps))
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


def make_yardstick() -> Callable[[], None]:
    """A fixed piece of work to measure speed by: the speed of a machine drifts, ratios to the yardstick hardly do.

    Four products of 512 x 512 float32 matrices and four copies of 4 MiB, always on the CPU, on one thread.
    """
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(YARDSTICK_MATRIX, YARDSTICK_MATRIX, generator=generator) for _ in range(2))
    product = torch.empty_like(a)
    source, target = torch.randn(YARDSTICK_FLOATS, generator=generator), torch.empty(YARDSTICK_FLOATS)

    def work() -> None:
        for _ in range(4):
            torch.mm(a, b, out=product)
            target.copy_(source)

    return work


def peak_megabytes(run: Callable[[], object], device: torch.device) -> float | None:
    """Memory that a call takes beyond what was in use before it [MiB]; None where the system does not tell.

    On CUDA what torch allocated; on the CPU the growth of the process's resident memory, scratch of kernels included.
    """
    if device.type == "cuda":
        synchronise()
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        run()
        synchronise()
        return (torch.cuda.max_memory_allocated(device) - before) / 2**20
    if not sys.platform.startswith("linux"):
        return None
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)  # give freed memory back, or the call would find it and not grow
        Path("/proc/self/clear_refs").write_text("5")  # the high-water mark falls to what is resident now
    except (OSError, AttributeError):  # a C library without it, a container that forbids it
        return None
    before = _peak_resident()
    run()
    return _peak_resident() - before


def _peak_resident() -> float:
    for entry in Path(f"/proc/{os.getpid()}/status").read_text().splitlines():
        if entry.startswith("VmHWM"):
            return int(entry.split()[1]) / 1024
    raise RuntimeError("/proc/self/status: expected a line VmHWM, found none.")


class NotCaptured(RuntimeError):
    """A call that no CUDA graph can hold, with torch's reason."""


@dataclass(frozen=True)
class Captured(Generic[Result]):
    """A CUDA graph and what its calls returned."""

    graph: Any
    calls: int
    results: Result
    """Results of the last call, new after every replay."""
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
    """Time of all its launches in a call, together."""


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
