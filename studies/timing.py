"""How fast synthetic pictures are made, by stage.

Fills docs/synthetic.md (speed). Times are CPU seconds of all threads together: with one thread other work that goes on
beside it hardly changes them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from oasis_warp.synthetic import picture
from oasis_warp.synthetic.people import person
from oasis_warp.synthetic.shots import EVERYBODY, PHOTOS, PICTURES_EACH, sample_table
from studies.harness import Row, StudyOptions, measured
from studies.tables import Column, Section, table

GEOMETRY = "posing, depth buffers of camera and lamps, normals, stretch"
STAGES = {
    **dict.fromkeys(("pose_people", "depth_map", "surface_state", "light_lamps", "_stretch"), GEOMETRY),
    "see_sky": "hidden sky", "shade_skin": "shading", "trace_rooms": "room", "expose": "sensor",
}  # fmt: skip
"""Functions of `synthetic.picture` that are timed, each up to the end of its work on the device, and their stages."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    threads: int | None = 1
    size: int = 256
    """Side of pictures [px]."""
    batch: int = 8
    repeats: int = 5
    seed: int = 0


def wait(device: str) -> None:
    """Until the device has done its work."""
    if device == "cuda":
        torch.cuda.synchronize()


def measure_stages(options: Options) -> list[Row]:
    """Each stage and all together, the fastest of the repeats."""
    # One thread is timed by its own clock: other work on the machine does not count then.
    clock = time.thread_time if options.device == "cpu" and options.threads == 1 else time.perf_counter
    spent: dict[str, float] = {}

    def timed(name: str, function: Callable) -> Callable:
        def run(*args, **kwargs):
            wait(options.device)
            start = clock()
            out = function(*args, **kwargs)
            wait(options.device)
            spent[name] = spent.get(name, 0.0) + clock() - start
            return out

        return run

    def best(function: Callable[[], object]) -> dict[str, float]:
        """Milliseconds per picture of everything that is timed."""
        rows = []
        for _ in range(options.repeats):
            spent.clear()
            function()
            rows.append(dict(spent))
        return {name: 1e3 * min(row[name] for row in rows) / options.batch for name in rows[0]}

    for number in range(-(-options.batch // PICTURES_EACH)):
        person(options.seed, number, EVERYBODY, options.device)
    plan = partial(timed("planning", sample_table), options.seed, range(options.batch), PHOTOS)
    render = partial(
        timed("together", picture.render_table), options.seed, plan(), options.size, options.device, scene=PHOTOS
    )
    render()  # builds or loads kernels
    found = best(plan) | best(render)
    originals = {name: getattr(picture, name) for name in STAGES}
    try:
        for name, function in originals.items():
            setattr(picture, name, timed(STAGES[name], function))
        stages = best(render)
    finally:
        for name, function in originals.items():
            setattr(picture, name, function)
    return [{"stage": name, "ms": ms} for name, ms in (stages | found).items()]


def run(options: Options) -> list[Row]:
    """Time the stages on the device."""
    return measured("timing", {f"pictures on {options.device}": (options,)}, measure_stages, options)


COLUMNS = Column("stage", "stage"), Column("ms a picture", "ms", ".3g")
SECTIONS = (Section("synthetic.md", "speed", table(COLUMNS)),)
