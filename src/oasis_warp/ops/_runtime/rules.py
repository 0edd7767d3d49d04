"""The rasterizer's thresholds; measurements replace them to see the cost and gain of each."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from oasis_kernels.constants import Rules

_GSPLAT = Rules()
_rules: ContextVar[Rules] = ContextVar("rules", default=_GSPLAT)


def current_rules() -> Rules:
    """The rules of the operators called from here: those of gsplat, unless inside `using`."""
    return _rules.get()


@contextmanager
def using(rules: Rules) -> Iterator[None]:
    """Draw by other `rules` inside the block; forward and backward of one picture belong in the same block."""
    token = _rules.set(rules)
    try:
        yield
    finally:
        _rules.reset(token)
