"""A sentence about a wrong command line, made from the box of many lines that tyro prints about it."""

import itertools
import re
import textwrap
from collections.abc import Iterable, Sequence

from oasis_warp.core.errors import did_you_mean, one_line, shortened

KINDS = {"INT": "a whole number", "FLOAT": "a number", "PATH": "a path", "STR": "text"}
"""What placeholders of the help mean."""


def sections(box: str) -> list[list[str]]:
    """The lines of each part of a box, or of the same without a frame (in ASCII), but for its title."""
    found: list[list[str]] = [[]]
    for line in box.splitlines():
        text = re.sub(r"^│ ?| *│$", "", line)
        if re.fullmatch(r" *(─{3,}|-{3,}) *", text):
            found.append([])
        elif text.strip() and text[0] not in "╭╰":
            found[-1].append(text)
    parts = [textwrap.dedent("\n".join(part)).splitlines() for part in found]
    return parts if box.lstrip().startswith("╭") else parts[1:]  # without a frame the title is a part


def explain(box: str, arguments: Sequence[str], about: str, known: Iterable[str] = ()) -> str:
    """What is wrong, what is expected, and where to read more.

    Args:
        box: What tyro printed.
        arguments: The command line without the program's name.
        about: The command, `oasis render`.
        known: Its options, `--size`, from which a mistyped one is guessed.
    """
    parts, command = sections(box), "".join(f"{name}: " for name in about.split()[1:])
    words = " ".join(" ".join(parts[0] if parts else [box]).split())
    if words.startswith("Missing from"):
        names = [line.strip().split(",")[0] for line in parts[0] if re.match(r" {4}\S", line)]
        sentence = f"{command}expected {' and '.join(names)}, got none"
    elif found := re.match(r"Unrecognized (?:or misplaced )?options: (\S+?)(?:,|$| )", words):
        name = one_line(shortened(found[1]))
        near = did_you_mean(name, known).removeprefix("Did you mean ").rstrip("?")
        sentence = f"{name}: not an option of `{about}`" if name[0] == "-" else f"{command}{name} is one name too many"
        sentence += f" (did you mean {near}?)" if near else ""
    elif found := re.match(r"Error parsing (\S+):", words):
        shown = next((part[1] for part in parts if part and part[0].startswith("Argument helptext")), "").split()
        kinds = [word for word in shown if not word.startswith("-") and not word.endswith(",")]
        wanted = f"{len(kinds)} values" if len(kinds) > 1 else _kinds(kinds[0]) if kinds else "another value"
        sentence = f"{_given(found[1], arguments)}: expected {wanted}"
    elif found := re.match(r"invalid choice .* for argument '(\S+)'\. Expected one of \((.*)\)", words):
        choices = found[2].replace("'", "").strip(",")
        sentence = f"{_given(found[1], arguments)}: expected one of {choices}"
    elif found := re.match(r"Missing value for argument '(\S+)'", words):
        sentence = f"{found[1]}: expected a value, got none"
    elif found := re.match(r"Expected one of \{(.*)\}", words):
        sentence = f"{command}expected one of {found[1]}"
    else:
        sentence = one_line(shortened(words, 400)).rstrip(".")
    return f"{sentence}; see `{about} --help`."


def _given(option: str, arguments: Sequence[str]) -> str:
    """An option and the value that it was given."""
    after = [b for a, b in itertools.pairwise(arguments) if a == option]
    return f"{option} {one_line(shortened(after[-1]))}" if after else option


def _kinds(placeholder: str) -> str:
    """The placeholder of an option in words: `{left,right}|INT` is "left, right or a whole number"."""
    names: list[str] = []
    for kind in re.findall(r"\{[^}]*\}|[^|{}]+", placeholder):
        names.extend(kind[1:-1].split(",") if kind[0] == "{" else [KINDS.get(kind, kind)])
    return " or ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
