"""How fast everything is on a GPU: on the host's clock, in a CUDA graph, and how exact."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import torch
from torch import Tensor

from oasis_warp.bench.gpu_cases import Case, Draw, Named, Way
from oasis_warp.bench.gpu_profile import kernel_times
from oasis_warp.bench.gpu_timing import STEPS_A_GRAPH, Captured, NotCaptured, Probe, Sample, capture, time_groups
from oasis_warp.bench.operators import Outputs, Results
from oasis_warp.bench.rows import commit, device_name, versions
from oasis_warp.bench.scenes import Scene
from oasis_warp.bench.timing import peak_megabytes, synchronise
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.reference.errors import largest_error, relative_error, same_bits

MOST = 0.9999
"""Share of the pixels that `GpuRow.most_abs` is the largest error of."""


@dataclass(frozen=True, kw_only=True)
class GpuRow:
    """One way to compute one case. Times are medians of groups of calls, in milliseconds a call."""

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
    """Of the GPU, by a CUDA graph that holds ten calls; None where there is no graph."""
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
    """Largest error of any pixel; None where there is no picture."""
    most_abs: float | None
    """Largest error of 99.99 % of the pixels."""
    rel_l2: float
    """Largest relative error of any output, without pixels where a decision hangs on rounding."""
    gradient_rel_l2: float | None
    bit_equal: bool
    """Whether a second call, and the graph, give the same bits."""
    not_captured: str
    """Why there is no graph; "" where there is one."""
    groups: int
    calls: int
    """In each group on the host's clock."""
    device: str
    seed: int
    commit: str
    versions: str


def gsplat_draw() -> Draw:
    """The rasterizer of gsplat, which draws on CUDA devices.

    Raises:
        InputError: it is not installed.
    """
    if find_spec("gsplat") is None:
        raise InputError("--peer gsplat: the package is not installed; `pip install gsplat` brings it.")
    import gsplat

    def draw(scene: Scene) -> Outputs:
        image, alphas, _ = gsplat.rasterization(
            scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks,
            scene.width, scene.height, backgrounds=scene.backgrounds, packed=False,
        )  # fmt: skip
        return image, alphas

    return draw


def measure(
    cases: Sequence[Named],
    device: torch.device,
    *,
    groups: int,
    seed: int = 0,
    peers: Mapping[str, Draw] | None = None,
    progress: Progress = silent,
) -> list[GpuRow]:
    """Rows of every way of every case, those of a case timed in turns.

    Args:
        cases: What to time.
        device: Where; on the CPU there are no graphs, and host times only.
        groups: Of calls, at least 2; medians are over them.
        seed: Of the scenes.
        peers: Other rasterizers, by name.
        progress: Told after every case.
    """
    rows: list[GpuRow] = []
    for done, named in enumerate(cases):
        rows += measure_case(named.make(device, seed, peers or {}), device, groups)
        progress("speed", done + 1, len(cases))
    return rows


@dataclass(frozen=True)
class Graphs:
    """A call as CUDA graphs, or why there are none."""

    one: Captured[Results] | None = None
    ten: Captured[Results] | None = None
    reason: str = ""


def make_graphs(way: Way, device: torch.device) -> Graphs:
    """Graphs of one call and of ten."""
    if device.type != "cuda":
        return Graphs(reason="no CUDA device")
    if way.captured is None:
        return Graphs()  # a peer that no graph can hold, or graphs already
    try:
        return Graphs(capture(way.captured), capture(way.captured, STEPS_A_GRAPH))
    except NotCaptured as error:
        return Graphs(reason=str(error))


def measure_case(case: Case, device: torch.device, groups: int) -> list[GpuRow]:
    """A row for each way."""
    graphs = {name: make_graphs(way, device) for name, way in case.ways.items()}
    probes: dict[tuple[str, str], Probe] = {}
    for name, way in case.ways.items():
        probes[name, "wall"] = Probe(way.run)
        for kind, captured in (("launch", graphs[name].one), ("busy", graphs[name].ten)):
            if captured is not None:
                probes[name, kind] = captured.probe()
    samples = dict(zip(probes, time_groups(list(probes.values()), groups), strict=True))
    rows = []
    for name, way in case.ways.items():
        found, again = way.run(), way.run()
        captured = graphs[name].one
        equal = same_bits(found.tensors, again.tensors)
        if captured is not None:
            captured.graph.replay()
            synchronise()
            equal = equal and same_bits(captured.results.tensors, found.tensors) and not captured.overflow.happened()
        times = kernel_times(way.run) if device.type == "cuda" else []
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
                peak_mb=peak_megabytes(way.run, device),
                **errors(case, found),
                bit_equal=equal,
                not_captured=graphs[name].reason,
                groups=len(wall.times_ms),
                calls=wall.calls,
                device=device_name(device),
                seed=case.seed,
                commit=commit(),
                versions=versions(),
            )
        )
    return rows


def median(sample: Sample | None) -> float | None:
    """Its median, if there is a sample."""
    return None if sample is None else sample.median_ms


def errors(case: Case, found: Results) -> dict[str, float | None]:
    """The columns of a row that say how exact it is."""
    values = zip(found.values, case.truth.values, strict=True)
    judged = None if case.judged is None or not case.image else case.judged[..., None]
    relative = [relative_error(v, e, None if judged is None else judged.expand_as(e)) for v, e in values]
    gradients = zip(found.gradients, case.truth.gradients, strict=True)
    return {
        "max_abs": largest_error(found.values[0], case.truth.values[0]) if case.image else None,
        "most_abs": most_error(found.values[0], case.truth.values[0]) if case.image else None,
        "rel_l2": max(relative),
        "gradient_rel_l2": max((relative_error(g, e) for g, e in gradients), default=None),
    }


def most_error(got: Tensor, exact: Tensor, share: float = MOST) -> float:
    """Largest error of that share of the pixels of pictures [C, H, W, D] that are best."""
    each = (got.double() - exact.double()).abs().amax(-1).flatten()
    return float(each.kthvalue(max(1, int(share * len(each)))).values)
