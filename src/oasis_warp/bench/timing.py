"""Time calls side by side, and see how much memory they take."""

import ctypes
import gc
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch

SLOW_MS = 100.0
"""Calls from here on are not repeated for warm caches: those of their own data are cold anyway."""


@dataclass(frozen=True)
class Timed:
    """One call to be timed."""

    run: Callable[[], object]
    threads: int
    """CPU threads that torch and our kernels may use."""
    around: Callable[[], AbstractContextManager[object]] = nullcontext
    """Surroundings of the call, whose own time does not count."""

    @contextmanager
    def ready(self) -> Iterator[None]:
        """Everything about the call set up inside the block."""
        with using_threads(self.threads), self.around():
            yield


@dataclass(frozen=True)
class Timing:
    """Wall time of a synchronised call, and the CPU time of the process in it."""

    first_ms: float
    """The first call, with compiling or loading its kernels."""
    times_ms: tuple[float, ...]
    cpu_times_ms: tuple[float, ...]

    @property
    def median_ms(self) -> float:
        """What a call takes in the middle."""
        return statistics.median(self.times_ms)

    @property
    def iqr_ms(self) -> float:
        """Distance of the quartiles."""
        low, _, high = statistics.quantiles(self.times_ms, n=4)
        return high - low

    @property
    def fastest_ms(self) -> float:
        """What it takes at best."""
        return min(self.times_ms)

    @property
    def cpu_ms(self) -> float:
        """CPU time at best, that of all threads added up: what waiting for other work does not inflate."""
        return min(self.cpu_times_ms)


@contextmanager
def using_threads(threads: int) -> Iterator[None]:
    """Let torch and our kernels use this many CPU threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def synchronise() -> None:
    """Wait for the GPU, where there is one at work."""
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


def time_together(
    calls: Sequence[Timed], repeats: int, after_round: Callable[[int], object] | None = None
) -> list[Timing]:
    """Time `calls` in turns, so that a machine that gets slower does so for all of them.

    Every call is warmed up; each round then goes through the calls, beginning with another one each time, and runs
    each twice in a row: the first run fetches its data into the caches, the second is timed.

    Args:
        calls: What to time.
        repeats: Rounds, at least 2.
        after_round: Told how many rounds are done.
    """
    if repeats < 2:
        raise ValueError(f"repeats: expected 2 or more, got {repeats}.")
    first, warm = [], []
    times: list[list[tuple[float, float]]] = [[] for _ in calls]
    for call in calls:
        with call.ready():
            first.append(milliseconds(call.run)[0])
            warm.append(milliseconds(call.run)[0])
    collecting = gc.isenabled()
    gc.disable()
    try:
        for done in range(repeats):
            for place in range(len(calls)):
                k = (place + done) % len(calls)
                with calls[k].ready():
                    if warm[k] < SLOW_MS:
                        calls[k].run()
                    times[k].append(milliseconds(calls[k].run))
            gc.collect()
            if after_round is not None:
                after_round(done + 1)
    finally:
        if collecting:
            gc.enable()
    return [Timing(f, *zip(*t, strict=True)) for f, t in zip(first, times, strict=True)]


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
    before = _resident("VmHWM")
    run()
    return _resident("VmHWM") - before


def _resident(line: str) -> float:
    for entry in Path(f"/proc/{os.getpid()}/status").read_text().splitlines():
        if entry.startswith(line):
            return int(entry.split()[1]) / 1024
    raise RuntimeError(f"/proc/self/status: expected a line {line}, found none.")
