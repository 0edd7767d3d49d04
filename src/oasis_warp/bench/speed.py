"""How fast every operator is: beside a yardstick and the same in torch, in one run."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch

from oasis_warp.bench.operators import Exact, Operator, Outputs, Pass, exact, forward, gradients
from oasis_warp.bench.rows import commit, device_name, versions
from oasis_warp.bench.scalar import generic_kernels
from oasis_warp.bench.scenes import MeshScene, Scene, hand_scenes, surfels
from oasis_warp.bench.timing import Timed, peak_megabytes, time_together
from oasis_warp.bench.yardstick import make_yardstick
from oasis_warp.core.logging import Progress, silent
from oasis_warp.reference.errors import relative_error


@dataclass(frozen=True, kw_only=True)
class SpeedRow:
    """One way to compute an operator.

    Ratios are those of CPU times where one thread does the work, else of the fastest calls: other work on the machine
    delays a call, but hardly adds to its CPU time.
    """

    op: str
    pass_: str
    """Called `pass` in files."""
    way: str
    """"warp" is ours, "scalar" our generic kernels in float32 on the CPU, "torch" the same in torch."""
    scene: str
    gaussians: int
    """In the scene."""
    faces: int | None
    """Of its mesh, where it has one."""
    width: int
    height: int
    device: str
    threads: int
    median_ms: float
    iqr_ms: float
    fastest_ms: float
    cpu_ms: float | None
    """Of all threads, in the call with the least; None on CUDA."""
    first_ms: float
    repeats: int
    peak_mb: float | None
    over_yardstick: float
    """Time over the yardstick's."""
    over_warp: float
    """Time over ours."""
    rel_l2: float
    """Largest relative error of any output against our float64 kernels, fragile pixels left out."""
    gradient_rel_l2: float | None
    seed: int
    commit: str
    versions: str


@dataclass(frozen=True)
class Way:
    """How operators are computed."""

    choose: Callable[[Operator], Callable[..., Outputs] | None]
    """From an operator to the call that computes it, where there is one."""
    around: Callable[[], AbstractContextManager[object]] = nullcontext
    """Surroundings of every call."""


WARP = Way(lambda operator: operator.call)
SCALAR = Way(lambda operator: operator.call if operator.vectorised else None, generic_kernels)
TORCH = Way(lambda operator: operator.torch_peer)


def measure(
    operators: Sequence[Operator],
    *,
    device: torch.device,
    gaussians: int,
    size: int,
    threads: int,
    repeats: int,
    seed: int = 0,
    progress: Progress = silent,
) -> list[SpeedRow]:
    """Rows of every way to compute the `operators`, each operator's timed in turns.

    Args:
        operators: Of `OPERATORS`.
        device: Where to compute.
        gaussians: Of the hand, to be drawn.
        size: Side of the picture [px].
        threads: CPU threads.
        repeats: Timed calls of each.
        seed: Of the scene.
        progress: Told after every round.
    """
    drawn, mesh = surfels(gaussians, size, seed), hand_scenes(size, seed)[1]
    ways = {"warp": WARP, **({"scalar": SCALAR} if device.type == "cpu" else {}), "torch": TORCH}
    rows: list[SpeedRow] = []
    for place, operator in enumerate(operators):

        def after_round(n: int, done: int = place * repeats) -> None:
            progress("speed", done + n, len(operators) * repeats)

        scene = (drawn if operator.scene is Scene else mesh).to(device=device)
        rows += measure_operator(operator, scene, ways, device, threads, repeats, after_round)
    return rows


def measure_operator(
    operator: Operator,
    scene: Scene | MeshScene,
    ways: dict[str, Way],
    device: torch.device,
    threads: int,
    repeats: int,
    after_round: Callable[[int], object] | None = None,
) -> list[SpeedRow]:
    """Rows of one operator; the first of `ways` is ours."""
    truth = exact(operator, scene)
    runs = timed_passes(operator, scene, ways, truth, threads)
    yardstick, *timings = time_together([Timed(make_yardstick(), 1), *runs.values()], repeats, after_round)
    by_cpu = device.type == "cpu" and threads == 1
    costs = {key: t.cpu_ms if by_cpu else t.fastest_ms for key, t in zip(runs, timings, strict=True)}
    ours = next(iter(ways))
    rows = []
    for ((pass_, way), timed), timing in zip(runs.items(), timings, strict=True):
        with timed.ready():
            value_error, gradient_error = errors(
                operator, truth, runs["forward", way].run(), timed.run() if pass_ != "forward" else None
            )
            memory = peak_megabytes(timed.run, device)
        rows.append(
            SpeedRow(
                op=operator.name,
                pass_=pass_,
                way=way,
                scene=scene.name,
                gaussians=len(scene.means if isinstance(scene, Scene) else scene.quats),
                faces=len(scene.faces) if isinstance(scene, MeshScene) else None,
                width=scene.width,
                height=scene.height,
                device=device_name(device),
                threads=threads,
                median_ms=timing.median_ms,
                iqr_ms=timing.iqr_ms,
                fastest_ms=timing.fastest_ms,
                cpu_ms=timing.cpu_ms if device.type == "cpu" else None,
                first_ms=timing.first_ms,
                repeats=repeats,
                peak_mb=memory,
                over_yardstick=costs[pass_, way] / yardstick.cpu_ms,
                over_warp=costs[pass_, way] / costs[pass_, ours],
                rel_l2=value_error,
                gradient_rel_l2=gradient_error,
                seed=scene.seed,
                commit=commit(),
                versions=versions(),
            )
        )
    return rows


def timed_passes(
    operator: Operator, scene: Scene | MeshScene, ways: dict[str, Way], truth: Exact, threads: int
) -> dict[tuple[Pass, str], Timed]:
    """What is timed, by pass and name of the way."""
    prepared = operator.prepare(scene)
    weights = tuple(w.to(torch.float32) for w in truth.weights)

    def run(call: Callable[..., Outputs], pass_: Pass) -> Callable[[], Outputs]:
        if pass_ == "forward":
            return lambda: forward(call, prepared, {})
        return lambda: gradients(operator, call, prepared, {}, weights)

    return {
        (pass_, name): Timed(run(call, pass_), threads, way.around)
        for pass_ in operator.passes
        for name, way in ways.items()
        if (call := way.choose(operator)) is not None
    }


def errors(
    operator: Operator, truth: Exact, outputs: Outputs, found: Outputs | None
) -> tuple[float, float | None]:
    """Largest relative errors of values and, where there are some, of gradients."""
    judged = None if truth.judged is None else truth.judged[..., None]
    values = [
        relative_error(o, e, None if judged is None else judged.expand_as(e))
        for o, e in zip(operator.comparable(outputs), truth.outputs, strict=True)
    ]
    if found is None:
        return max(values), None
    return max(values), max(relative_error(g, e) for g, e in zip(found, truth.gradients, strict=True))
