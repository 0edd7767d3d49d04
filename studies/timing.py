"""How fast synthetic pictures are made, by stage, and how long the learned prior takes to load and to encode one photo.

Fills docs/synthetic.md (speed) and docs/prior.md (speed). CPU seconds are those of all threads together; with one
thread they are its time, whatever other work goes on beside it.
"""

import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import HandCrop, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import NetworkPrior, choose_prior
from oasis_warp.synthetic import picture
from oasis_warp.synthetic.people import person
from oasis_warp.synthetic.shot_table import sample_table
from oasis_warp.synthetic.shots import EVERYBODY, PHOTOS, PICTURES_EACH
from studies.harness import Row, StudyOptions, measured, prior_choice
from studies.tables import Column, Section, table

GEOMETRY = "posing, depth buffers of camera and lamps, normals, stretch"
STAGES = {
    **dict.fromkeys(("pose_people", "depth_map", "surface_state", "light_lamps", "_stretch"), GEOMETRY),
    "see_sky": "hidden sky", "shade_skin": "shading", "trace_rooms": "room", "expose": "sensor",
}  # fmt: skip
"""Functions of `synthetic.picture` that are timed, each up to the end of its work on the device, and their stages."""
WARM_UP, CROP = 3, 256


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"of", "device"})
    of: tuple[Literal["pictures", "prior"], ...] = ("pictures", "prior")
    prior: str = "learned"
    """learned, or a weights file."""
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


def device_words(options: Options) -> str:
    """The device, for people."""
    return torch.cuda.get_device_name() if options.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"


# ---- pictures


def time_pictures(options: Options) -> list[Row]:
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


# ---- the prior


def noise_crop(device: torch.device) -> HandCrop:
    """An open hand in front of noise: what the photo shows does not change the time."""
    hand = bundled_hand().to(device)
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names), device=device))
    orientation = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], device=device)  # palm to the camera
    pose = HandPose(named_pose(hand, "open"), orientation, torch.tensor([0.0, 0, 0.5], device=device))
    posed = skin(hand, rest, pose)
    image = torch.rand(CROP, CROP, 3, generator=torch.Generator().manual_seed(0)).to(device)
    mask = torch.ones(CROP, CROP, device=device)
    return HandCrop(image, mask, mask, orbit_camera(posed.vertices, 0.0, size=CROP), rest, posed)


def time_prior(options: Options) -> Row:
    """Seconds and memory, with the hand, sizes and precision of `oasis reconstruct`."""
    device = torch.device(options.device)
    bundled_hand()
    before, busy = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    prior = choose_prior(prior_choice(options.prior))
    if not isinstance(prior, NetworkPrior):
        raise SystemExit(f"{options.prior}: expected a network, got the prior {prior.about['name']!r}.")
    wait(options.device)
    loading, crop = time.process_time() - busy, noise_crop(device)
    for _ in range(WARM_UP):
        prior(crop)
    if options.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    times, cpu_times = [], []
    for _ in range(4 * options.repeats):
        wait(options.device)
        start, busy = time.perf_counter(), time.process_time()
        prior(crop)
        wait(options.device)
        times.append(time.perf_counter() - start)
        cpu_times.append(time.process_time() - busy)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
    memory = torch.cuda.max_memory_allocated() / 2**30 if options.device == "cuda" else grown
    return {
        "device": device_words(options), "torch": torch.__version__, "load_s": loading,
        "fastest_ms": 1e3 * min(times), "median_ms": 1e3 * statistics.median(times), "cpu_ms": 1e3 * min(cpu_times),
        "gib": memory,
    }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Time what is asked for."""
    measure = {"pictures": time_pictures, "prior": time_prior}
    rows: list[Row] = []
    for of in options.of:
        rows += measured("timing", {f"{of} on {options.device}": (options,)}, measure[of], options)
    return rows


SECTIONS = (
    Section("synthetic.md", "speed", table(
        (Column("stage", "stage"), Column("ms a picture", "ms", ".3g")),
        lambda rows: [row for row in rows if row["case"] == "pictures on cpu"],
    )),
    Section("prior.md", "speed", table(
        (
            Column("device", "device"), Column("loading, CPU time", lambda row: f"{row['load_s']:.2f} s"),
            Column("encoding, fastest", lambda row: f"{row['fastest_ms']:.1f} ms"),
            Column("median", lambda row: f"{row['median_ms']:.1f} ms"),
            Column("CPU time", lambda row: f"{row['cpu_ms']:.1f} ms"),
            Column("memory", lambda row: f"{row['gib']:.2f} GiB"), Column("torch", "torch"),
        ),
        lambda rows: [row for row in rows if "load_s" in row],
    )),
)  # fmt: skip
