"""Machine-readable record of a command: its exact words for reports, and the file of `--json`."""

import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from oasis_warp import __version__

COMMANDS = "commands.txt"


@dataclass
class Record:
    """A command that runs."""

    command: str
    """As a shell takes it."""
    quiet: bool = False
    facts: dict[str, Any] = field(default_factory=dict)


_running: ContextVar[Record | None] = ContextVar("running", default=None)


def exact_command() -> str | None:
    """The words of the command that runs, as a shell takes them; None outside `oasis`."""
    record = _running.get()
    return None if record is None else record.command


def keep_command(folder: Path) -> None:
    """Add the words of the command to `COMMANDS` in its folder of results: a line for each that worked on them.

    Raises:
        InputError: the file cannot be written.
    """
    from oasis_warp.data.output_files import write_file  # with torch, which the command has loaded

    file = folder / COMMANDS
    if (command := exact_command()) is None or not folder.is_dir():
        return
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    if command not in lines:
        write_file(file, "".join(f"{line}\n" for line in [*lines, command]).encode())


def is_quiet() -> bool:
    """Whether only errors are to be said."""
    record = _running.get()
    return record is not None and record.quiet


def written(path: Path | str) -> None:
    """Say that the command has written a file or folder, and note it."""
    if (record := _running.get()) is not None:
        record.facts.setdefault("written", []).append(str(path))
    if not is_quiet():
        print(f"written: {path}")


def note(**facts: Any) -> None:
    """Add facts to the file of `--json`."""
    if (record := _running.get()) is not None:
        record.facts.update(facts)


@contextmanager
def recorded(chosen: Any, arguments: Sequence[str]) -> Iterator[Record]:
    """Hold the record of a command while it runs."""
    record = Record(shlex.join(["oasis", *arguments]), getattr(chosen, "quiet", False))
    token = _running.set(record)
    try:
        yield record
    finally:
        _running.reset(token)


def write_record(chosen: Any, record: Record, code: int, error: str | None, start: float) -> None:
    """Write the file of `--json` for a command that has none of its own.

    Args:
        chosen: The command's options.
        record: What it noted.
        code: Its exit code.
        error: The sentence about what went wrong.
        start: When it began, by `time.monotonic`.

    Raises:
        InputError: the file cannot be written.
    """
    from oasis_warp.cli.report import to_json  # with torch, which the command has loaded
    from oasis_warp.data.output_files import write_file

    options = {name: value for name, value in asdict(chosen).items() if name not in ("json", "quiet", "verbose")}
    head = {"command": record.command, "creator": f"oasis_warp {__version__}", "exit_code": code, "error": error}
    seconds = round(time.monotonic() - start, 3)
    write_file(chosen.json, to_json({**head, "seconds": seconds, "options": options, **record.facts}).encode())
