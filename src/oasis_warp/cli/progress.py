"""The progress of a whole run: its share that is done, and the time that the rest takes."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from oasis_warp.core.config import ReconstructConfig

FAMILIAR = 0.3
"""Seconds of work after which what a run has taken counts as much for its speed as what a plan says."""
NEARLY = 0.95
"""Most of a step that counts as done while it is not."""
LAST_PHOTOS = 100
"""Photos by which the pace of several workers is judged, and one more that takes its time by plan."""
USUAL_STEPS = 84
"""Steps of texture learning of 5 of 6 photos of the tests; its limit is 400."""


class Step(NamedTuple):
    """A part of a run that ends with an event of its stage."""

    stage: str
    seconds: float
    """On one core of a server of 2024. Only ratios matter: the run itself tells how fast this machine is."""
    usual: int = 0
    """Number of its parts after which it usually ends, where the total that it reports is only a limit."""
    once: bool = False
    """Whether it takes longer in a first run, and so says nothing on the machine's speed."""


def reconstruct_plan(config: ReconstructConfig, n_photos: int) -> tuple[Step, ...]:
    """The steps of `reconstruct` and of its pictures.

    Seconds are those of the process, with one thread, of 5 single photos of the tests and of 2 of one hand, in
    November 2026.
    """
    n, texture = n_photos, USUAL_STEPS if config.steps is None else config.steps
    plan = [
        Step("prior", 1.0), Step("landmarks", 0.15 + 0.3 * n), Step("fit", 1.05 if n == 1 else 1.9 * n),
        Step("outline", 1.15 * n - 0.2), Step("kernels", 0.1, once=True), Step("crop", 0.02 * n),
        Step("prior", 0.08 + 0.7 * n), *([Step("refinement", 2.0 * n)] if config.refine == "on" else []),
        Step("outline", 0.45 * n), Step("calibration", 0.1 + 0.8 * n), Step("completion", 0.15 * n),
        Step("texture", (0.9 + 4.2 * n) * texture / USUAL_STEPS, USUAL_STEPS if config.steps is None else 0),
        Step("adaptation", 0.02), *[Step("colours", 4.2)] * n, Step("detail", 0.03),
        *([Step("painting", 1.2)] if config.unseen == "painted" else []), Step("quality", 0.1 + 0.35 * n),
        Step("summary", 0.4 + 0.2 * n), Step("summary", 0.35), Step("turntable", 1.8), Step("turntable", 1.3),
        Step("save", 0.02),
    ]  # fmt: skip
    return tuple(plan)


EDIT_PLAN = (
    Step("kernels", 0.05, once=True), Step("difference", 0.05), Step("registration", 1.5), Step("colours", 3.0),
    Step("paint", 0.02), Step("summary", 1.0),
)  # fmt: skip
"""Of `edit`, a spot of 2 cm² on a photo of the tests, measured as that of `reconstruct`."""


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
            self._inside, self._since = min(done / (step.usual or total), NEARLY), self._clock()

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
        """Of the whole run that is done, 0 to 1; within a step, as far as its time has passed."""
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
        self, n_photos: int, config: ReconstructConfig, n_workers: int, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        step = Step("photos", sum(step.seconds for step in reconstruct_plan(config, 1)) / n_workers)
        super().__init__([step], clock=clock)
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
        """Of the photos that are done, 0 to 1."""
        self._shown = max(self._shown, self._ready / self._n)
        return self._shown

    @property
    def left(self) -> float:
        """Seconds that the rest of the run takes."""
        (first, since), (last, until) = self._ended[0], self._ended[-1]
        planned = self._plan[0].seconds
        pace = (until - since + planned) / (last - first + 1)
        return max(0.0, (self._n - self._ready) * pace - (self._clock() - until))
