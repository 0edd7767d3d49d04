"""The package logger and the progress callback. Nothing is printed outside `oasis_warp.cli`."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

logger = logging.getLogger("oasis_warp")


@runtime_checkable
class Progress(Protocol):
    """Callback of long work."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """A `Progress` that reports nothing."""


@contextmanager
def timed_stage(stage: str, seconds: dict[str, float], progress: Progress = silent) -> Iterator[None]:
    """Add the time of the block to `seconds[stage]`, which becomes the last entry, and report start and end."""
    progress(stage, 0, 1)
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.pop(stage, 0.0) + time.perf_counter() - start
    progress(stage, 1, 1)
