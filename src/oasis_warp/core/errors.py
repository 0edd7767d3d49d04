"""The exception for user errors, and "Did you mean ...?" suggestions."""

import difflib
from collections.abc import Iterable

MAX_LETTERS, MAX_QUOTED = 1000, 80
"""Longest message and longest quotation: a file's own words may go on for megabytes."""


def one_line(text: object) -> str:
    """The text with control characters, such as line breaks and escape codes, written out."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


def shortened(text: str, most: int = MAX_QUOTED) -> str:
    """At most `most` letters of what a message quotes, the middle left out."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-(most // 2) :]}"


def last_line(output: str, nothing: str = "it said nothing", most: int = 300) -> str:
    """The last line of a failed program's output, at most so many letters; `nothing` if there was none."""
    return (output.strip().splitlines() or [nothing])[-1].removeprefix("oasis: ")[:most]


class InputError(ValueError):
    """Invalid input of the user; the message is one sentence: where, what is wrong, what to do.

    The command line prints it without a traceback and exits with code 2. Messages quote files and names that others
    made, so they are cut to a length, and what is not printable is written out.
    """

    def __init__(self, message: str = ""):
        super().__init__(one_line(shortened(message, MAX_LETTERS)))


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The question "Did you mean ...?" with the nearest of the `known` names; empty where none is near."""
    near = difflib.get_close_matches(name, list(known), 1)
    return f"Did you mean {near[0]!r}?" if near else ""
