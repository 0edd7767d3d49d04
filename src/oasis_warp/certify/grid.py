"""Thousands of seeded scenes against the twins, spread over processes."""

import math
import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed

import torch

from oasis_warp.certify.compare import Measurement, compare
from oasis_warp.certify.families import FAMILIES

CHUNK = 20
"""Scenes a process is given at a time."""


def check_scene(name: str, seed: int, device: torch.device) -> list[Measurement]:
    """Everything that one scene has to keep; what it raises is a measurement too."""
    family = FAMILIES[name]
    case = family.scene(seed)
    try:
        return compare(family, case, torch.float32, device)
    except Exception as error:  # any way to fail is what the grid looks for
        said = f"{case}: {type(error).__name__}: {error}"
        return [Measurement(name, "calls that end in an error", said, math.inf, 0.0)]


def scenes(names: Sequence[str], n: int, seed: int) -> list[tuple[str, int]]:
    """`n` pairs (operator, seed), the operators in turn and each with consecutive seeds."""
    return [(names[i % len(names)], seed + i // len(names)) for i in range(n)]


def run_grid(
    todo: Sequence[tuple[str, int]], device: torch.device, n_processes: int
) -> Iterator[tuple[int, list[Measurement]]]:
    """How many scenes were checked and what was measured, chunk after chunk as they are done."""
    chunks = [todo[i : i + CHUNK] for i in range(0, len(todo), CHUNK)]
    if n_processes == 1:
        for chunk in chunks:
            yield check_chunk(chunk, str(device))
        return
    pool = ProcessPoolExecutor(n_processes, multiprocessing.get_context("spawn"), start_worker)
    try:
        for done in as_completed([pool.submit(check_chunk, chunk, str(device)) for chunk in chunks]):
            yield done.result()
    except BaseException:  # Ctrl-C above all: do not wait for what is being measured
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def start_worker() -> None:
    """Leave Ctrl-C to the parent, which ends the pool; one thread a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


def check_chunk(chunk: Sequence[tuple[str, int]], device: str) -> tuple[int, list[Measurement]]:
    """How many scenes there were, and all their measurements."""
    place = torch.device(device)
    return len(chunk), [m for name, seed in chunk for m in check_scene(name, seed, place)]
