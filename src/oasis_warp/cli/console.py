"""Shared by every command: exit codes, progress on the terminal, and the check of --device."""

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from rich.console import Console, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from oasis_warp.cli.progress import Run
from oasis_warp.cli.record import is_quiet
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent

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
    return Console(markup=False, quiet=is_quiet())


@contextlib.contextmanager
def show_progress(console: Console) -> Iterator[Progress]:
    """Show a `Progress` without a plan on `console` while the block runs: a bar a stage on a terminal, else lines."""
    if is_quiet():
        yield silent
        return
    if not console.is_terminal:
        yield line_progress(lambda line: console.print(line, highlight=False, soft_wrap=True))
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(SpinnerColumn(), *columns, console=console, transient=True) as bars:
        yield bar_progress(bars)


@contextlib.contextmanager
def show_run(console: Console, run: Run) -> Iterator["Shown"]:
    """Show a run on `console` while the block runs: one bar with the time left on a terminal, else a line a stage."""
    if is_quiet():
        yield Shown(run, contextlib.nullcontext)
    elif console.is_terminal:
        with _RunBar(run, console) as bar:
            yield Shown(run, bar.paused)
    else:
        lines = line_progress(lambda line: console.print(line, highlight=False, soft_wrap=True), run=run)
        yield Shown(lines, contextlib.nullcontext)


class Shown(NamedTuple):
    """A run on the screen."""

    progress: Progress
    paused: Callable[[], contextlib.AbstractContextManager[Any]]
    """A context in which other text may be printed."""


class _RunBar(Bars):
    """One bar, which follows a run on its own clock."""

    def __init__(self, run: Run, console: Console) -> None:
        self._run = run
        self._bar: TaskID | None = None
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[left]}"))
        super().__init__(SpinnerColumn(), *columns, console=console, transient=True)
        self._bar = self.add_task("", total=1.0, left="")

    def get_renderables(self) -> Iterable[RenderableType]:
        if self._bar is not None:
            self.update(self._bar, completed=self._run.share, description=escape(self._run.what), left=_left(self._run))
        return super().get_renderables()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Take the bar away while the block runs."""
        self.stop()
        try:
            yield
        finally:
            self.start()


def _left(run: Run) -> str:
    minutes, seconds = divmod(max(1, round(run.left)), 60)
    hours, minutes = divmod(minutes, 60)
    left = f"{hours} h {minutes} min" if hours else f"{minutes} min" if minutes > 9 else f"{60 * minutes + seconds} s"
    return f"{100 * run.share:.0f} %, about {left} left"


def bar_progress(bars: Bars) -> Progress:
    """A `Progress` with one bar per stage."""
    tasks = {}

    def progress(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=total)
        bars.update(tasks[stage], completed=done, total=total)

    return progress


def line_progress(
    write: Callable[[str], object], clock: Callable[[], float] = time.monotonic, run: Run | None = None
) -> Progress:
    """A `Progress` that writes a line at the end of each stage, and every `LINE_EVERY` seconds before.

    Those between say how much of the stage is done, or of the `run`. Of stages within stages only the outer one counts.
    """
    started: dict[str, float] = {}
    written: dict[str, float] = {}
    part, last = "", ""

    def progress(stage: str, done: int, total: int) -> None:
        nonlocal part, last
        now = clock()
        if run is not None:
            run(stage, done, total)
            if run.part("") != part:  # what a photo that failed has begun has not ended
                part = run.part("")
                last = ""
                started.clear()
            if done >= total and stage not in started and stage == last:  # its inner part, of the same name, ended it
                return
        outer = next(iter(started), stage)
        start = started.setdefault(stage, now)
        if done >= total:
            del started[stage]
            written.pop(stage, None)
            if run is None or outer == stage:
                last = stage
                write(f"{run.part(stage) if run else stage}: {now - start:.1f} s")
        elif done and now - written.setdefault(outer, start) >= LINE_EVERY:
            written[outer] = now
            left = (now - start) / done * (total - done)
            write(f"{run.what}: {_left(run)}" if run else f"{stage}: {done} of {total}, about {left:.0f} s left")

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
