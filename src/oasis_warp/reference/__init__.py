"""The operators written out in plain torch, differentiated by torch: one implementation for two uses.

In float64 on small scenes they are the oracle of `certify`; in float32 on large ones they are the peer that `bench`
times the kernels against. They share no code and no constants with the kernels.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any


def named(name: str) -> Callable[..., Any]:
    """The function "module.function" of this package, as declarations of operators name it."""
    module, function = name.split(".")
    return getattr(import_module(f"{__name__}.{module}"), function)
