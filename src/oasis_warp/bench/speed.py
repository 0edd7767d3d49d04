"""How fast everything is.

On the CPU every operator stands beside a yardstick, its generic kernels and the same in torch, in one run. On a GPU
cases are timed on the host's clock and in a CUDA graph, and their errors are told.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import torch

from oasis_warp.bench.gpu_cases import CaseMaker, GpuCase, Implementation, Peers
from oasis_warp.bench.knobs import DEFAULT, GENERIC, TORCH, Setting, measure_settings_of
from oasis_warp.bench.operators import Call, Operator, Outputs, Pass, Results
from oasis_warp.bench.rows import provenance, scene_columns
from oasis_warp.bench.scenes import GaussianScene, MeshScene, hand_scenes, surfels
from oasis_warp.bench.timing import (
    GRAPH_CALLS,
    Captured,
    NotCaptured,
    Probe,
    Sample,
    capture,
    kernel_times,
    peak_megabytes,
    synchronise,
    time_groups,
)
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.reference.errors import largest_error, most_error, same_bits


@dataclass(frozen=True, kw_only=True)
class SpeedRow:
    """One backend of an operator.

    Ratios are those of CPU times for one thread, else of the fastest calls: other work on the machine delays a call,
    but hardly adds to its CPU time.
    """

    op: str
    pass_: Pass
    """Called `pass` in files."""
    way: str
    """"warp" is ours, "scalar" our generic kernels in float32 on the CPU, "torch" the same in torch."""
    scene: str
    gaussians: int
    """In the scene."""
    faces: int | None
    """Faces of the scene's mesh, where it has one."""
    width: int
    height: int
    device: str
    threads: int
    median_ms: float
    iqr_ms: float
    fastest_ms: float
    cpu_ms: float | None
    """CPU time of all threads, in the call with the least; None on CUDA."""
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


def backends(operator: Operator, device: torch.device) -> dict[str, Setting]:
    """How an operator is computed, by name; the first is ours."""
    scalar = {"scalar": GENERIC} if device.type == "cpu" and operator.vectorised else {}
    return {"warp": DEFAULT, **scalar, "torch": TORCH}


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
        operators: Entries of `OPERATORS`.
        options: Device, threads and repeats.
        gaussians: Number of Gaussians of the hand to draw.
        size: Side of the image [px].
        seed: Seed of the scene.
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
    named = backends(operator, options.device)
    truth, found = measure_settings_of(
        operator, scene, list(named.values()), options.device, options.threads, options.repeats, after_round
    )
    rows = [
        SpeedRow(
            op=operator.name,
            way=next(name for name, setting in named.items() if setting is m.setting),
            **scene_columns(scene),
            **m.columns,
            over_yardstick=m.cost_ms / m.yardstick_ms,
            over_warp=m.cost_ms / next(o.cost_ms for o in found if o.setting is DEFAULT and o.pass_ == m.pass_),
            rel_l2=truth.value_error(m.results.values),
            gradient_rel_l2=truth.gradient_error(m.results.gradients),
            **provenance(options.device),
        )
        for m in found
    ]
    return sorted(rows, key=lambda row: operator.passes.index(row.pass_))


@dataclass(frozen=True, kw_only=True)
class GpuRow:
    """One implementation of one case. Times are medians of groups of calls, in milliseconds a call."""

    case: str
    pass_: str
    """Called `pass` in files."""
    way: str
    """"warp" is ours; or a peer."""
    gaussians: int
    faces: int | None
    views: int
    width: int
    height: int
    wall_ms: float
    """On the host's clock, with one wait after many calls."""
    wall_iqr_ms: float
    busy_ms: float | None
    """GPU time, measured by a CUDA graph that holds ten calls; None where there is no graph."""
    busy_iqr_ms: float | None
    launch_ms: float | None
    """The same by a graph of one call: with the launch of a graph, as a program that waits for nothing has it."""
    kernels_ms: float | None
    """Sum of the kernels' times in eager calls, by the profiler: without gaps, and for those that no graph holds."""
    kernels: float | None
    """Kernels, copies and fills of a call."""
    peak_mb: float | None
    """Memory beyond what was in use before the call [MiB]."""
    max_abs: float | None
    """Largest error of any pixel; None where there is no image."""
    most_abs: float | None
    """Largest error of 99.99 % of the pixels."""
    rel_l2: float
    """Largest relative error of any output, without pixels where a decision depends on rounding."""
    gradient_rel_l2: float | None
    bit_equal: bool
    """Whether a second call and the graph give the same bits."""
    not_captured: str
    """Why there is no graph; "" where there is one."""
    groups: int
    calls: int
    """In each group on the host's clock."""
    device: str
    seed: int
    commit: str
    versions: str


def gsplat_draw() -> Call:
    """Gsplat's rasterizer, which draws on CUDA devices.

    Raises:
        InputError: it is not installed.
    """
    if find_spec("gsplat") is None:
        raise InputError("--peer gsplat: the package is not installed; `pip install gsplat` brings it.")
    import gsplat

    def draw(scene: GaussianScene) -> Outputs:
        image, alphas, _ = gsplat.rasterization(
            scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks,
            scene.width, scene.height, backgrounds=scene.backgrounds, packed=False,
        )  # fmt: skip
        return image, alphas

    return draw


def measure_cases(
    cases: Sequence[CaseMaker],
    device: torch.device,
    *,
    groups: int,
    seed: int = 0,
    peers: Peers | None = None,
    progress: Progress = silent,
) -> list[GpuRow]:
    """Rows of every implementation of every case, those of a case timed in turns.

    Args:
        cases: What to time.
        device: Where; on the CPU there are no graphs, and host times only.
        groups: Groups of calls, at least 2; medians are over them.
        seed: Seed of the scenes.
        peers: Other rasterizers, by name.
        progress: Called after every case.
    """
    rows: list[GpuRow] = []
    for done, case in enumerate(cases):
        rows += measure_case(case.make(device, seed, peers or {}), device, groups)
        progress("speed", done + 1, len(cases))
    return rows


@dataclass(frozen=True)
class Graphs:
    """A call as CUDA graphs, or why there are none."""

    one: Captured[Results] | None = None
    ten: Captured[Results] | None = None
    reason: str = ""


def make_graphs(implementation: Implementation, device: torch.device) -> Graphs:
    """Graphs of one call and of ten."""
    if device.type != "cuda":
        return Graphs(reason="no CUDA device")
    if implementation.captured is None:
        return Graphs()  # a peer that no graph can hold, or graphs already
    try:
        return Graphs(capture(implementation.captured), capture(implementation.captured, GRAPH_CALLS))
    except NotCaptured as error:
        return Graphs(reason=str(error))


def measure_case(case: GpuCase, device: torch.device, groups: int) -> list[GpuRow]:
    """A row for each implementation."""
    graphs = {name: make_graphs(one, device) for name, one in case.implementations.items()}
    probes: dict[tuple[str, str], Probe] = {}
    for name, implementation in case.implementations.items():
        probes[name, "wall"] = Probe(implementation.run)
        for kind, captured in (("launch", graphs[name].one), ("busy", graphs[name].ten)):
            if captured is not None:
                probes[name, kind] = captured.probe()
    samples = dict(zip(probes, time_groups(list(probes.values()), groups), strict=True))
    rows = []
    for name, implementation in case.implementations.items():
        found = implementation.run()
        times = kernel_times(implementation.run) if device.type == "cuda" else []
        wall, busy, launch = (samples.get((name, kind)) for kind in ("wall", "busy", "launch"))
        assert wall is not None
        rows.append(
            GpuRow(
                case=case.name,
                pass_=case.pass_,
                way=name,
                gaussians=case.gaussians,
                faces=case.faces,
                views=case.views,
                width=case.width,
                height=case.height,
                wall_ms=wall.median_ms,
                wall_iqr_ms=wall.iqr_ms,
                busy_ms=median(busy),
                busy_iqr_ms=None if busy is None else busy.iqr_ms,
                launch_ms=median(launch),
                kernels_ms=1e-3 * sum(t.us for t in times) if times else None,
                kernels=sum(t.launches for t in times) if times else None,
                peak_mb=peak_megabytes(implementation.run, device),
                **errors(case, found),
                bit_equal=repeats_bits(implementation, graphs[name].one, found),
                not_captured=graphs[name].reason,
                groups=len(wall.times_ms),
                calls=wall.calls,
                seed=case.seed,
                **provenance(device),
            )
        )
    return rows


def median(sample: Sample | None) -> float | None:
    """Its median, if there is a sample."""
    return None if sample is None else sample.median_ms


def repeats_bits(implementation: Implementation, captured: Captured[Results] | None, found: Results) -> bool:
    """Whether another call, and a replay of the graph whose lists do not overflow, give the bits of `found`."""
    equal = same_bits(found.tensors, implementation.run().tensors)
    if captured is None:
        return equal
    captured.graph.replay()
    synchronise()
    return equal and same_bits(captured.results.tensors, found.tensors) and not captured.overflow.happened()


def errors(case: GpuCase, found: Results) -> dict[str, float | None]:
    """The columns of a row that say how exact it is."""
    image, exact_image = found.values[0], case.truth.values[0]
    return {
        "max_abs": largest_error(image, exact_image) if case.image else None,
        "most_abs": most_error(image, exact_image) if case.image else None,
        "rel_l2": case.truth.value_error(found.values),
        "gradient_rel_l2": case.truth.gradient_error(found.gradients),
    }
