"""The package logger and the progress callback. Nothing is printed outside `oasis_warp.cli`."""

import logging
from typing import Protocol, runtime_checkable

logger = logging.getLogger("oasis_warp")


@runtime_checkable
class Progress(Protocol):
    """What long work calls: the stage's name, how much of it is done and out of how much."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """A `Progress` that reports nothing."""
