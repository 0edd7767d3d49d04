"""CPU kernels written as one C++ snippet each, that take raw pointers and share their work among threads themselves.

The one argument of such a kernel is the address of its parameter block: 64-bit words, pointers or whole numbers, in the
order in which the kernel names them. A launch is one call of the snippet; several threads may launch the same kernel
with the same block at once, to work on it together: the snippet deals out numbered tasks with `phase`.
"""

import hashlib
from dataclasses import dataclass
from typing import Any

import warp as wp

from oasis_kernels.runtime.vectors import cpu_options


@dataclass(frozen=True)
class Native:
    """A snippet as a kernel, and the names of its parameters, in order."""

    kernel: Any
    parameters: tuple[str, ...]
    """The first is `give_way`: the address of a function without arguments that lets other threads run, or 0."""


PHASE = """
    // Do the tasks 0 .. n - 1 of a phase together with whoever else has this block. A thread waits only for tasks that
    // another one has begun: it never matters whether, or when, a thread arrives. `share` returns when none is left to
    // begin, and is for the last phase of a kernel; `phase` when all are done.
    auto share = [&](long long* state, long long n, auto&& task) {
        long long t;
        while ((t = __atomic_fetch_add(state, 1, __ATOMIC_RELAXED)) < n) {
            task(t);
            __atomic_fetch_add(state + 8, 1, __ATOMIC_RELEASE);
        }
    };
    auto phase = [&](long long* state, long long n, auto&& task) {
        share(state, n, task);
        for (int spins = 0; __atomic_load_n(state + 8, __ATOMIC_ACQUIRE) < n; spins++) {
    #if defined(__x86_64__)
            __builtin_ia32_pause();
    #endif
            if (spins > 1000 && give_way) ((void (*)())give_way)();  // the other one may wait for this core
        }
    };
"""
"""C++: `phase(state, n, task)` and `share`. `state` are 16 words of zeros: the next task, and the number of those done,
each on a cache line of its own."""

PHASE_WORDS = 16


def native(name: str, parameters: dict[str, str], body: str) -> Native:
    """Build the kernel `name` from the C++ `body`, which sees each of `parameters` (name: C++ type) as a constant."""
    parameters = {"give_way": "long long", **parameters}
    words = [f"{kind} const {p} = ({kind})words[{k}];" for k, (p, kind) in enumerate(parameters.items())]
    text = "\n    ".join(["const long long* words = (const long long*)block;", *words]) + PHASE + body

    def snippet(block: wp.uint64): ...

    # Warp keeps functions by name, and a second one of a name takes the place of the first.
    snippet.__qualname__ = f"{name}_{hashlib.sha1(text.encode()).hexdigest()[:16]}"
    run = wp.func_native(text)(snippet)

    def launch(block: wp.uint64):
        run(block)

    launch.__name__ = launch.__qualname__ = name
    return Native(wp.kernel(launch, module="unique", module_options=cpu_options()), tuple(parameters))
