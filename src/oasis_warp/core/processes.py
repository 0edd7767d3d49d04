"""Worker processes, and the threads of this one."""

import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager

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


class _SharedLimits:
    """One thread for torch and BLAS, while any thread is inside `single_threaded_math`."""

    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0

    def enter(self) -> int:
        """Limit this thread, and the process if it is the first; how many threads torch had without limits."""
        with self._lock:
            if self._users == 0:
                self._threads = torch.get_num_threads()
                # threadpoolctl restores limits of OpenBLAS only in the thread that set them, and ours may end earlier.
                self._keeper = ThreadPoolExecutor(1)
                self._blas = self._keeper.submit(threadpool_limits, limits=1, user_api="blas").result()
            self._users += 1
            torch.set_num_threads(1)
            return self._threads

    def leave(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._keeper.submit(self._blas.restore_original_limits).result()
                self._keeper.shutdown()
                torch.set_num_threads(self._threads)
            else:  # OpenMP's number is that of this thread, but torch would also set MKL's, which all threads share
                threadpool_limits(limits=self._threads, user_api="openmp")


_limits, _own = _SharedLimits(), threading.local()


def kernel_threads() -> int:
    """How many CPU threads our kernels may use: as many as torch, or as it had before `single_threaded_math`."""
    return getattr(_own, "threads", None) or torch.get_num_threads()


@contextmanager
def single_threaded_math() -> Iterator[None]:
    """Run torch's operators, and the BLAS of NumPy, SciPy and OpenCV, on one thread inside the block.

    Several threads may be in such blocks at once: the process keeps its limits until the last one leaves.

    Our kernels keep as many threads as before. Results of torch and BLAS depend on their number of threads, and their
    threads spin while they wait: on 32 cores a photo took 42 s of processor time instead of 5. Our kernels do neither.
    """
    if getattr(_own, "threads", None):  # inside such a block already
        yield
        return
    _own.threads = _limits.enter()
    try:
        with threadpool_limits(limits=1, user_api="blas"):  # some keep a limit for each thread
            yield
    finally:
        _own.threads = None
        _limits.leave()
