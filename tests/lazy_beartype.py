"""beartype that writes the check of a function when it is first called: a test run calls a few of thousands."""

import functools

from beartype import beartype


def checked(function):
    """`function`, checked as `beartype(function)` is."""
    check = functools.cache(lambda: beartype(function))

    @functools.wraps(function)
    def call(*args, **kwargs):
        return check()(*args, **kwargs)

    return call
