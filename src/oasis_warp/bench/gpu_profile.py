"""Which kernels a call runs on the GPU, and for how long, by torch's profiler."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch

WARP_KERNEL = re.compile(r"(.+)_[0-9a-f]{8}_cuda_kernel_(forward|backward)")
"""What Warp makes of a kernel's name."""


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
