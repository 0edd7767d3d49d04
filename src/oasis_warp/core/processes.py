"""Worker processes, and the threads of this one."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from threadpoolctl import threadpool_limits


def worker_pool(workers: int, *keep: Callable[[], object]) -> ProcessPoolExecutor:
    """A pool of processes with one thread each, which call `keep` first.

    They ignore Ctrl-C, which a terminal sends to all processes: the one that started them ends them.
    """
    # A forked child of a process with a CUDA context or threads may hang; a spawned one does not.
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=spawn, initializer=_start, initargs=keep)


def _start(*keep: Callable[[], object]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    for each in keep:
        each()


@contextmanager
def using_threads(threads: int) -> Iterator[None]:
    """Let torch and our kernels use this many CPU threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


_kernel_threads: ContextVar[int | None] = ContextVar("threads that torch does not use", default=None)


def kernel_threads() -> int:
    """How many CPU threads our kernels may use: as many as torch, or as it had before `single_threaded_math`."""
    return _kernel_threads.get() or torch.get_num_threads()


@contextmanager
def single_threaded_math() -> Iterator[None]:
    """Run torch's operators, and the BLAS of NumPy, SciPy and OpenCV, on one thread inside the block.

    Our kernels keep as many threads as before. Results of torch and BLAS depend on their number of threads, and their
    threads spin while they wait: on 32 cores a photo took 42 s of processor time instead of 5. Our kernels do neither.
    """
    before = _kernel_threads.set(kernel_threads())
    try:
        with using_threads(1), threadpool_limits(limits=1, user_api="blas"):
            yield
    finally:
        _kernel_threads.reset(before)
