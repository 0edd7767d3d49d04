"""Worker processes, and the threads of this one."""

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

import torch


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """A pool of processes with one thread each.

    They ignore Ctrl-C, which a terminal sends to all processes: the one that started them ends them.
    """
    # A forked child of a process with a CUDA context or threads may hang; a spawned one does not.
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start)


def _start() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


@contextmanager
def using_threads(threads: int) -> Iterator[None]:
    """Let torch and our kernels use this many CPU threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
