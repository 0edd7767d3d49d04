"""What every command shares: exit codes, progress on the terminal, and the check of --device."""

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress

FAULT = 1
"""`oasis doctor` found something broken, `oasis gradcheck` an error beyond its bound."""
BAD_INPUT = 2
"""Something the user gave cannot be used; one sentence on stderr says what. Also for a wrong command line."""
INTERRUPTED = 130
"""Stopped by Ctrl-C, as shells count: 128 + SIGINT."""


LINE_EVERY = 5.0
"""Seconds between two lines of one stage without a terminal."""


def plain_console() -> Console:
    """The console for results: brackets in the names of files are no markup."""
    return Console(markup=False)


@contextlib.contextmanager
def show_progress(console: Console) -> Iterator[Progress]:
    """Show a `Progress` on `console` while the block runs: bars on a terminal, else lines."""
    if not console.is_terminal:
        yield line_progress(lambda line: console.print(line, highlight=False, soft_wrap=True))
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(SpinnerColumn(), *columns, console=console, transient=True) as bars:
        yield bar_progress(bars)


def bar_progress(bars: Bars) -> Progress:
    """A `Progress` with one bar per stage."""
    tasks = {}

    def progress(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=total)
        bars.update(tasks[stage], completed=done, total=total)

    return progress


def line_progress(write: Callable[[str], object], clock: Callable[[], float] = time.monotonic) -> Progress:
    """A `Progress` that writes a line at the end of each stage, and every `LINE_EVERY` seconds before."""
    started: dict[str, float] = {}
    written: dict[str, float] = {}

    def progress(stage: str, done: int, total: int) -> None:
        now = clock()
        start = started.setdefault(stage, now)
        if done >= total:
            write(f"{stage}: {now - start:.1f} s")
            del started[stage]
            written.pop(stage, None)
        elif done and now - written.setdefault(stage, start) >= LINE_EVERY:
            written[stage] = now
            left = (now - start) / done * (total - done)
            write(f"{stage}: {done} of {total}, about {left:.0f} s left")

    return progress


def print_tables(tables: Iterable[Table], width: int) -> None:
    """Print tables, on a terminal narrower than `width` characters as if it had these, so that no number is cut."""
    console = plain_console()
    if console.width < width:
        console.width = width
    for table in tables:
        console.print(table)


def check_device(device: str) -> None:
    """Check that torch can compute on `device`.

    Raises:
        InputError: there is no CUDA device.
    """
    import torch  # takes seconds, which `oasis --help` saves

    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch finds no CUDA device; use --device cpu, or see `oasis doctor`.")
