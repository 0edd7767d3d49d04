"""Worker processes that draw and bake ahead."""

import multiprocessing
import signal
from concurrent.futures import ProcessPoolExecutor

import torch


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """So many processes, of one thread each.

    They leave Ctrl-C, which a terminal sends to all, to the process that started them: it ends them in its own time.
    """
    # A forked child of a process with a CUDA context or threads may hang, a spawned one does not.
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start)


def _start() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
