"""How fast synthetic pictures are made, by stage, with everything on and the people baked.

python studies/time_synthetic.py --device cuda --batch 64
python studies/time_synthetic.py --device cuda --size 256 --training --workers 14  # batches of training, end to end
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch

from oasis_warp.pretraining.synthetic_source import SyntheticHands
from oasis_warp.synthetic import picture
from oasis_warp.synthetic.people import person
from oasis_warp.synthetic.shot_table import sample_table
from oasis_warp.synthetic.shots import EVERYBODY, PHOTOS, PICTURES_EACH

STAGES = ("pose_people", "depth_map", "surface_state", "light_lamps", "see_sky", "_stretch", "shade_skin",
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
    kernels: bool = False
    """List the GPU's time by kernel, too."""
    training: bool = False
    """Time batches of `pretraining.synthetic_source` in place of the stages; `size` is that of the crops then."""
    hands: int = 16
    views: int = 2
    people: int = 64
    workers: int = 0
    ahead: int = 8
    """Batches that are rendered together."""


def main(options: Options) -> None:
    """Measure and print."""
    torch.set_num_threads(options.threads)
    (time_training if options.training else time_stages)(options)


def time_training(options: Options) -> None:
    """Data of a training step, and how long the process that asks for it is kept from other work."""
    source = SyntheticHands(
        seed=options.seed, people=options.people, hands=options.hands, views=options.views, size=options.size,
        device=torch.device(options.device), workers=options.workers, ahead=options.ahead,
    )  # fmt: skip
    start = time.perf_counter()
    source.bake(list(range(options.people)), None, max(options.workers, 1))
    print(f"people: {time.perf_counter() - start:.1f} s")
    batches = source(0, 0, 1)

    def several() -> tuple[float, float]:
        start = time.perf_counter()
        for _ in range(options.ahead):
            next(batches)
        asked = time.perf_counter() - start
        if options.device == "cuda":
            torch.cuda.synchronize()
        return asked / options.ahead * 1e3, (time.perf_counter() - start) / options.ahead * 1e3

    for _ in range(2):
        several()
    asked, done = zip(*(several() for _ in range(options.repeats)), strict=True)
    print(f"{options.hands} photos and {options.hands * options.views} targets, crops of {options.size} px, "
          f"{options.ahead} batches at once")  # fmt: skip
    print(f"a batch: {min(done):.1f} ms, mean {sum(done) / len(done):.1f} ms; "
          f"the call returns after {min(asked):.1f} ms")  # fmt: skip
    if options.kernels and options.device == "cuda":
        list_kernels(several, options.hands * (1 + options.views) * options.ahead)


def list_kernels(render: Callable[[], object], pictures: int) -> None:
    """GPU time of each kernel."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        render()
    spent = sorted(profile.key_averages(), key=lambda row: -row.device_time_total)
    print(f"on the GPU: {sum(row.device_time_total for row in spent) / pictures:.0f} us a picture")
    for row in spent[:30]:
        print(f"  {row.device_time_total / pictures:8.2f} us a picture, {row.count:4d} x {row.key[:90]}")


def time_stages(options: Options) -> None:
    """The fastest of the repeats."""
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
    planned = sample_table(options.seed, indices, PHOTOS)

    def render() -> float:
        wait()
        start = clock()
        picture.render_table(options.seed, planned, options.size, options.device, scene=PHOTOS)
        wait()
        return clock() - start

    first = render()
    best = min(render() for _ in range(options.repeats))
    planning = []
    for _ in range(options.repeats):
        start = clock()
        sample_table(options.seed, indices, PHOTOS)
        planning.append(clock() - start)
    print(f"first batch, kernels built or loaded: {first:.2f} s")
    print(f"planning, on one core: {min(planning) / options.batch * 1e3:.2f} ms a picture")
    print(f"rendering {options.size} px, batch {options.batch}: {best / options.batch * 1e3:.2f} ms a picture, "
          f"{options.batch / best:.1f} a second")  # fmt: skip
    if options.kernels and options.device == "cuda":
        list_kernels(render, options.batch)
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
    import tyro  # workers that plan need not have it, nor who calls `main`

    main(tyro.cli(Options))
