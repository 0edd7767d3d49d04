"""beartype that writes the check of a function when it is first called: a test run calls a few of thousands."""

import functools

from beartype import beartype

_checks = {}
"""Checks of functions that are defined in others, by what beartype reads: they are defined anew in every call."""


def checked(function):
    """`function`, checked as `beartype(function)` is.

    jaxtyping gives a function without a body, so that those with the same name and annotations have the same check.
    """

    @functools.cache
    def check():
        code, annotations = function.__code__, repr(function.__annotations__)
        if "<locals>" not in function.__qualname__ or "<locals>" in annotations or function.__defaults__:
            return beartype(function)
        key = function.__module__, function.__qualname__, code.co_code, code.co_varnames, annotations
        if key not in _checks:
            _checks[key] = beartype(function)
        return _checks[key]

    @functools.wraps(function)
    def call(*args, **kwargs):
        return check()(*args, **kwargs)

    return call
