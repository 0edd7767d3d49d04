"""Run a CPU kernel on strips of an image, several at a time."""

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

STRIPS_A_THREAD = 3
"""More strips than threads: a hand covers the middle rows, and equal strips are unequal work."""


@functools.cache
def _pool(process: int, n_threads: int) -> ThreadPoolExecutor:
    # Keyed by the process: threads do not survive a fork, and a pool without its threads would wait for ever.
    return ThreadPoolExecutor(n_threads, thread_name_prefix="oasis_warp")


def for_strips(n_rows: int, run: Callable[[int, int], None]) -> None:
    """Call `run(first_row, last_row)` for strips that cover `n_rows` rows, on as many threads as torch uses.

    A CPU launch of Warp runs on the calling thread and releases the GIL. The kernel must be loaded already.
    """
    n_threads = min(torch.get_num_threads(), n_rows)
    if n_threads <= 1:
        run(0, n_rows - 1)
        return
    n_strips = min(n_threads * STRIPS_A_THREAD, n_rows)
    starts = [n_rows * s // n_strips for s in range(n_strips + 1)]
    strips = [(first, end - 1) for first, end in itertools.pairwise(starts)]
    for _ in _pool(os.getpid(), n_threads).map(lambda strip: run(*strip), strips):
        pass
