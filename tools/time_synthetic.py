"""How fast synthetic pictures are made, by stage, with everything on and the people baked.

python tools/time_synthetic.py --device cuda --batch 64
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
import tyro

from oasis_warp.synthetic import picture
from oasis_warp.synthetic.people import person
from oasis_warp.synthetic.plan import EVERYBODY, PHOTOS, PICTURES_EACH, plan_shots

STAGES = ("pose_people", "depth_map", "surface_state", "light_lamps", "see_sky", "_stretch", "_textures", "shade_skin",
          "trace_rooms", "expose")  # fmt: skip
"""Names in `picture` that are timed, each up to the end of its work on the device."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to time."""

    device: Literal["cpu", "cuda"] = "cpu"
    size: int = 256
    batch: int = 8
    repeats: int = 5
    threads: int = 1
    seed: int = 0


def main(options: Options) -> None:
    """Measure and print: the fastest of the repeats."""
    torch.set_num_threads(options.threads)
    # One thread is timed by its own clock: other work on the machine does not count then.
    clock = time.thread_time if options.device == "cpu" and options.threads == 1 else time.perf_counter

    def wait() -> None:
        if options.device == "cuda":
            torch.cuda.synchronize()

    spent: dict[str, float] = {}

    def timed(name: str, function: Callable) -> Callable:
        def run(*args, **kwargs):
            wait()
            start = clock()
            out = function(*args, **kwargs)
            wait()
            spent[name] = spent.get(name, 0.0) + clock() - start
            return out

        return run

    indices = range(options.batch)
    start = clock()
    for number in range(-(-options.batch // PICTURES_EACH)):
        person(options.seed, number, EVERYBODY, options.device)
    print(f"people: {clock() - start:.2f} s")
    shots = plan_shots(options.seed, indices)

    def render() -> float:
        wait()
        start = clock()
        picture.render_shots(options.seed, shots, options.size, options.device, scenery=PHOTOS)
        wait()
        return clock() - start

    first = render()
    best = min(render() for _ in range(options.repeats))
    planning = []
    for _ in range(options.repeats):
        start = clock()
        plan_shots(options.seed, indices)
        planning.append(clock() - start)
    print(f"first batch, kernels built or loaded: {first:.2f} s")
    print(f"planning, on one core: {min(planning) / options.batch * 1e3:.2f} ms a picture")
    print(f"rendering {options.size} px, batch {options.batch}: {best / options.batch * 1e3:.2f} ms a picture, "
          f"{options.batch / best:.1f} a second")  # fmt: skip
    for name in STAGES:
        setattr(picture, name, timed(name, getattr(picture, name)))
    rows = []
    for _ in range(options.repeats):
        spent.clear()
        render()
        rows.append(dict(spent))
    for name in STAGES:
        print(f"  {name.strip('_'):14s} {min(row[name] for row in rows) / options.batch * 1e3:7.2f} ms a picture")


if __name__ == "__main__":
    main(tyro.cli(Options))
