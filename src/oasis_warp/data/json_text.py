"""Read JSON that others wrote: one object, of bounded length and depth, without NaN."""

import json
from typing import Any, TypeGuard

from oasis_warp.core.errors import shortened

MOST_LETTERS = 1 << 20
"""Longest text; headers, poses and settings have a few thousand letters."""


def read_json(text: str | bytes) -> dict[str, Any]:
    """The object that `text` holds.

    Raises:
        ValueError: too long, no JSON, nested too deeply, with numbers that are none, or no object.
    """
    if len(text) > MOST_LETTERS:
        raise ValueError(f"expected at most {MOST_LETTERS >> 20} MB of JSON, got {len(text) >> 20} MB")
    try:
        value = json.loads(text, parse_constant=_refuse)
    except RecursionError:
        raise ValueError("expected JSON, got lists within lists without end") from None
    except ValueError as error:  # also undecodable bytes, and numbers of thousands of digits
        raise ValueError(f"expected JSON, got something else: {shortened(str(error))}") from None
    if not isinstance(value, dict):
        raise ValueError(f"expected a JSON object, got {type(value).__name__}")
    return value


def whole(value: object, low: int, high: int) -> TypeGuard[int]:
    """Whether a value of JSON is a whole number from `low` to `high`; `true` is none."""
    return type(value) is int and low <= value <= high


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is no number")
