"""How fast every operator is: beside a yardstick, its generic kernels and the same in torch, in one run."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from unittest.mock import patch

import torch
from torch import Tensor

from oasis_warp.bench.operators import Call, Exact, Operator, Pass, Results, exact, forward, with_gradients
from oasis_warp.bench.rows import provenance, scene_columns
from oasis_warp.bench.scenes import GaussianScene, MeshScene, hand_scenes, surfels
from oasis_warp.bench.timing import Timed, make_yardstick, peak_megabytes, time_together
from oasis_warp.core.logging import Progress, silent
from oasis_warp.ops._runtime import depth_buffer


@dataclass(frozen=True, kw_only=True)
class SpeedRow:
    """One backend of an operator.

    Ratios are those of CPU times for one thread, else of the fastest calls: other work on the machine delays a call,
    but hardly adds to its CPU time.
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
    """Time over that of "warp"."""
    rel_l2: float
    """Largest relative error of any output against our float64 kernels, fragile pixels left out."""
    gradient_rel_l2: float | None
    seed: int
    commit: str
    versions: str


@contextmanager
def generic_kernels() -> Iterator[None]:
    """Use the generic kernels inside the block, for float32 on the CPU too, and fill depth buffers as on CUDA.

    This is not an option of the operators, because only a benchmark needs it.
    """

    def no(tensor: Tensor) -> bool:
        return False

    modules = [module for name, module in sys.modules.items() if name.startswith("oasis_warp.ops.")]
    with ExitStack() as patched:
        for module in modules:
            if hasattr(module, "has_vectors"):
                patched.enter_context(patch.object(module, "has_vectors", no))
        patched.enter_context(patch.object(depth_buffer, "draw_by_vectors", depth_buffer.draw_by_faces))
        yield


@dataclass(frozen=True)
class Backend:
    """How operators are computed."""

    choose: Callable[[Operator], Call | None]
    """From an operator to the call that computes it, if there is one."""
    around: Callable[[], AbstractContextManager[object]] = nullcontext
    """A context for every call."""


WARP = Backend(lambda operator: operator.call)
SCALAR = Backend(lambda operator: operator.call if operator.vectorised else None, generic_kernels)
TORCH = Backend(lambda operator: operator.torch_call)


def backends(device: torch.device) -> dict[str, Backend]:
    """By name; the first is ours."""
    return {"warp": WARP, **({"scalar": SCALAR} if device.type == "cpu" else {}), "torch": TORCH}


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What is the same for all operators of a run."""

    device: torch.device
    threads: int = 1
    """CPU threads."""
    repeats: int
    """Timed calls of each."""


def measure_operators(
    operators: Sequence[Operator],
    options: RunOptions,
    *,
    gaussians: int,
    size: int,
    seed: int = 0,
    progress: Progress = silent,
) -> list[SpeedRow]:
    """Rows of every backend of the `operators`, those of an operator timed in turns.

    Args:
        operators: Of `OPERATORS`.
        options: Device, threads and repeats.
        gaussians: Of the hand, to draw.
        size: Side of the image [px].
        seed: Of the scene.
        progress: Called after every round.
    """
    drawn, mesh = surfels(gaussians, size, seed), hand_scenes(size, seed)[1]
    rows: list[SpeedRow] = []
    for k, operator in enumerate(operators):

        def after_round(n: int, done: int = k * options.repeats) -> None:
            progress("speed", done + n, len(operators) * options.repeats)

        scene = (drawn if operator.scene is GaussianScene else mesh).to(device=options.device)
        rows += measure_operator(operator, scene, options, after_round)
    return rows


def measure_operator(
    operator: Operator,
    scene: GaussianScene | MeshScene,
    options: RunOptions,
    after_round: Callable[[int], object] | None = None,
) -> list[SpeedRow]:
    """Rows of one operator."""
    device, threads = options.device, options.threads
    truth, named = exact(operator, scene), backends(device)
    runs = timed_passes(operator, scene, named, truth, threads)
    yardstick, *timings = time_together([Timed(make_yardstick(), 1), *runs.values()], options.repeats, after_round)
    by_cpu = device.type == "cpu" and threads == 1
    costs = {key: t.cpu_ms if by_cpu else t.fastest_ms for key, t in zip(runs, timings, strict=True)}
    rows = []
    for ((pass_, way), timed), timing in zip(runs.items(), timings, strict=True):
        with timed.ready():
            value_error, gradient_error = errors(truth, timed)
            memory = peak_megabytes(timed.run, device)
        rows.append(
            SpeedRow(
                op=operator.name,
                pass_=pass_,
                way=way,
                **scene_columns(scene),
                threads=threads,
                median_ms=timing.median_ms,
                iqr_ms=timing.iqr_ms,
                fastest_ms=timing.fastest_ms,
                cpu_ms=timing.cpu_ms if device.type == "cpu" else None,
                first_ms=timing.first_ms,
                repeats=options.repeats,
                peak_mb=memory,
                over_yardstick=costs[pass_, way] / yardstick.cpu_ms,
                over_warp=costs[pass_, way] / costs[pass_, "warp"],
                rel_l2=value_error,
                gradient_rel_l2=gradient_error,
                **provenance(device),
            )
        )
    return rows


def timed_passes(
    operator: Operator, scene: GaussianScene | MeshScene, named: dict[str, Backend], truth: Exact, threads: int
) -> dict[tuple[Pass, str], Timed]:
    """What is timed, by pass and name of the backend."""
    prepared = operator.prepare(scene)
    weights = tuple(w.to(torch.float32) for w in truth.weights)

    def runner(call: Call, pass_: Pass) -> Callable[[], Results]:
        if pass_ == "forward":
            return lambda: Results(forward(call, prepared, {}))
        return with_gradients(operator, call, prepared, {}, weights)

    return {
        (pass_, name): Timed(runner(call, pass_), threads, backend.around)
        for pass_ in operator.passes
        for name, backend in named.items()
        if (call := backend.choose(operator)) is not None
    }


def errors(truth: Exact, timed: Timed) -> tuple[float, float | None]:
    """Largest relative errors of the values of a call and, if it takes some, of its gradients."""
    found = timed.run()
    assert isinstance(found, Results)
    return truth.value_error(found.values), truth.gradient_error(found.gradients) if found.gradients else None
