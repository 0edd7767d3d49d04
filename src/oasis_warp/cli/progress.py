"""Shared by every command: exit codes, the check of --device, and progress on the terminal with the time left."""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from rich.console import Console, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from oasis_warp.cli.record import is_quiet
from oasis_warp.core.config import ReconstructConfig, adapt_config
from oasis_warp.core.logging import Progress, silent

FAULT = 1
"""`oasis doctor` found something broken, `oasis gradcheck` an error beyond its bound."""
BAD_INPUT = 2
"""Something the user gave cannot be used; one sentence on stderr says what. Also for a wrong command line."""
INTERRUPTED = 130
"""Stopped by Ctrl-C, as shells count: 128 + SIGINT."""


LINE_EVERY = 5.0
"""Seconds between two lines of one stage without a terminal."""
FAMILIAR = 0.3
"""Seconds of work after which what a run has taken counts as much for its speed as what a plan says."""
NEARLY = 0.95
"""Most of a step that counts as done while it is not."""
LAST_PHOTOS = 100
"""Photos by which the pace of several workers is judged, and one more that takes its time by plan."""


class Step(NamedTuple):
    """A part of a run that ends with an event of its stage."""

    stage: str
    seconds: float
    """On one core of a server of 2024. Only ratios matter: the run itself tells how fast this machine is."""
    once: bool = False
    """Whether it takes longer in a first run, and so says nothing on the machine's speed."""


def reconstruct_plan(config: ReconstructConfig, n_photos: int, *, pictures: bool = True) -> tuple[Step, ...]:
    """The steps of `reconstruct` and, if wanted, of its pictures.

    Seconds are those of the process, with one thread, of 5 single photos of the tests and of 2 of one hand, in
    November 2026; texture, colours and wrist were scaled to one photo when they took fewer steps.
    """
    n, texture = n_photos, adapt_config(config).texture_steps
    plan = [
        Step("prior", 1.0), Step("landmarks", 0.15 + 0.3 * n), Step("fit", 1.5 if n == 1 else 1.9 * n),
        Step("outline", 1.15 * n - 0.2), Step("kernels", 0.1, once=True), Step("crop", 0.02 * n),
        Step("prior", 0.08 + 0.75 * n), *([Step("refinement", 2.0 * n)] if config.refine == "on" else []),
        Step("outline", 0.3 * n), Step("calibration", 0.1 + 0.9 * n), Step("completion", 0.12 * n),
        Step("texture", (0.01 + 0.05 * n) * texture),
        Step("adaptation", 0.18), *[Step("colours", 2.3)] * n, Step("detail", 0.03),
        *([Step("painting", 1.5 + 0.7 * n)] if config.unseen == "painted" else []),
        *([Step("detail", 0.3 + 0.5 * n)] if config.light == "fit" else []), Step("wrist", 1.8),
        Step("quality", 0.1 + 0.75 * n),
    ]  # fmt: skip
    drawn = Step("summary", 1.5 + 0.2 * n), Step("summary", 0.3), Step("turntable", 7.3), Step("turntable", 0.3)
    return *plan, *(drawn if pictures else ()), Step("save", 0.07)


EDIT_PLAN = (
    Step("kernels", 0.05, once=True), Step("difference", 0.05), Step("registration", 1.5), Step("colours", 3.0),
    Step("paint", 0.02), Step("summary", 1.0),
)  # fmt: skip
"""Steps of `edit` with their seconds for a spot of 2 cm² on a photo of the tests, measured as for `reconstruct`."""


class Run:
    """A `Progress` that knows the plan of its run, which may consist of several equal parts, such as photos."""

    def __init__(
        self, plan: Sequence[Step], n_parts: int = 1, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._length = len(plan)
        self._plan = [*plan] * n_parts
        self._total = sum(step.seconds for step in self._plan)
        self._clock = clock
        self._started = self._since = clock()
        self._unlike = 0.0
        """Seconds that say nothing on the machine's speed."""
        self._place, self._inside = 0, 0.0
        self._skipped = 0.0
        """Seconds of steps of the plan that were left out."""
        self._part, self._stages, self._shown = "", [], 0.0

    def begin(self, part: int, name: str) -> None:
        """Say that the work on part 0, 1, ... begins, which messages call `name`."""
        self._move(part * self._length)
        self._part, self._stages = name, []

    def __call__(self, stage: str, done: int, total: int) -> None:
        """See `Progress`. A stage that is not in the plan is named, and takes no share."""
        ended = done >= total
        if stage in self._stages:
            if ended:
                del self._stages[self._stages.index(stage) :]
        elif not ended:
            self._stages.append(stage)
        place = next((k for k in range(self._place, len(self._plan)) if self._plan[k].stage == stage), None)
        if place is None or (done == 0 and not ended):
            return
        step = self._plan[place]
        if ended:
            self._move(place)
            if step.once:
                self._unlike += max(0.0, self._clock() - self._since - step.seconds)
            self._place, self._inside, self._since = place + 1, 0.0, self._clock()
        elif total > 1:
            self._move(place)
            self._inside, self._since = min(done / total, NEARLY), self._clock()

    def _move(self, place: int) -> None:
        """Leave out what lies between here and `place`."""
        if place > self._place:
            self._skipped += sum(step.seconds for step in self._plan[self._place : place])
            self._skipped -= self._inside * self._plan[self._place].seconds
            self._place, self._inside = place, 0.0

    @property
    def what(self) -> str:
        """The part and the stage in work."""
        return self.part(self._stages[-1] if self._stages else "")

    def part(self, stage: str) -> str:
        """The part in work, and a stage of it."""
        return ", ".join(text for text in (self._part, stage) if text)

    def _work(self) -> tuple[float, float, float]:
        """Seconds by the plan that are done and that the step in work still takes, and the machine's time for one."""
        done = sum(step.seconds for step in self._plan[: self._place])
        here = self._plan[self._place].seconds if self._place < len(self._plan) else 0.0
        done += self._inside * here
        taken = self._since - self._started - self._unlike
        return done, (1 - self._inside) * here, (taken + FAMILIAR) / (done - self._skipped + FAMILIAR)

    @property
    def share(self) -> float:
        """Share of the whole run that is done, 0 to 1; within a step, as far as its time has passed."""
        done, here, pace = self._work()
        now = done + min((self._clock() - self._since) / pace, NEARLY * here)
        self._shown = max(self._shown, now / self._total if self._total else 1.0)  # bars do not go back
        return self._shown

    @property
    def left(self) -> float:
        """Seconds that the rest of the run takes."""
        done, here, pace = self._work()
        return (self._total - done) * pace - min(self._clock() - self._since, NEARLY * here * pace)


class ManyPhotos(Run):
    """The progress of photos that several workers make: a number of them and not their stages.

    The rest takes as long as the last photos that took any work, whichever workers came or went.
    """

    def __init__(
        self, n_photos: int, config: ReconstructConfig, n_workers: int, *, pictures: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        plan = reconstruct_plan(config, 1, pictures=pictures)
        super().__init__([Step("photos", sum(step.seconds for step in plan) / n_workers)], clock=clock)
        self._n = max(1, n_photos)
        self._ready = 0
        self._ended = deque([(0, self._started)], maxlen=LAST_PHOTOS)

    def count(self, made: int, kept: int) -> None:
        """Say how many photos have been worked on in this run, and how many were there before."""
        if made > self._ended[-1][0]:
            self._ended.append((made, self._clock()))
        self._ready = made + kept

    @property
    def done(self) -> tuple[int, int]:
        """Photos that are done, and all."""
        return self._ready, self._n

    @property
    def what(self) -> str:
        """The same in words."""
        return f"{self._ready} of {self._n} photos"

    @property
    def share(self) -> float:
        """Share of the photos that are done, 0 to 1."""
        self._shown = max(self._shown, self._ready / self._n)
        return self._shown

    @property
    def left(self) -> float:
        """Seconds that the rest of the run takes."""
        (first, since), (last, until) = self._ended[0], self._ended[-1]
        planned = self._plan[0].seconds
        pace = (until - since + planned) / (last - first + 1)
        return max(0.0, (self._n - self._ready) * pace - (self._clock() - until))


class Terminal(Console):
    """Standard error for progress, whose reader may go, as `head` does: then nothing is shown, and the work goes on.

    Rich ends the thread that writes, which may be one that others wait for.
    """

    def __init__(self) -> None:
        super().__init__(stderr=True)

    def on_broken_pipe(self) -> None:
        """Show nothing more."""
        self.quiet = True


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
            what = escape(self._run.what or "working")
            self.update(self._bar, completed=self._run.share, description=what, left=_left(self._run))
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
