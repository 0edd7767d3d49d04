"""How time and memory grow with Gaussians, pixels and views, and whether the pictures stay right."""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.bench.gpu_cases import PASSES, RASTERIZATION, UNVALIDATED
from oasis_warp.bench.operators import Results, forward, one_pass
from oasis_warp.bench.roofline import Counts, count
from oasis_warp.bench.rows import provenance
from oasis_warp.bench.scenes import GaussianScene, crop, giants, one_tile, surface
from oasis_warp.bench.timing import GRAPH_CALLS, NotCaptured, Probe, capture, peak_megabytes, synchronise, time_groups
from oasis_warp.core.logging import Progress, silent
from oasis_warp.ops import rasterization
from oasis_warp.reference.errors import most_error, same_bits

GROUPS = 9
CALM = 1.5
"""Growth of time over growth of work from which on a step along an axis is a cliff."""
AFFORDABLE = {"cuda": 4 * 10**9, "cpu": 2 * 10**7}
"""Pixels of tiles times their lists up to which the float64 kernels draw the whole image in a second or two."""
CROP, RIM = 64, 48
"""Side of the part that is compared otherwise, and the margin that is drawn about it [px]: Gaussians from farther away,
whose projection is clamped by the image that they are drawn in, do not reach it."""
SETTLED = 3
"""Calls before memory is measured: the first ones learn how long the lists are."""


@dataclass(frozen=True)
class Point:
    """A point on an axis of the study."""

    axis: str
    """What grows: "gaussians", "pixels" or "views"; or "stress" for scenes that stand alone."""
    series: str
    """What stays the same."""
    make: Callable[[int], GaussianScene]
    """From a seed."""


@dataclass(frozen=True, kw_only=True)
class ScalingRow:
    """A pass at a point. Times are medians of groups of calls, in milliseconds a call."""

    axis: str
    series: str
    scene: str
    pass_: str
    gaussians: int
    views: int
    width: int
    height: int
    pairs: int
    """Pairs of a Gaussian and a tile of 8 x 8 pixels."""
    longest: int
    """List of a tile."""
    wall_ms: float
    busy_ms: float | None
    """GPU time, measured by a CUDA graph; None where there is none."""
    peak_mb: float | None
    """Memory beyond what was in use before the call [MiB]."""
    finite: bool
    """All values, and all gradients."""
    overflow: bool | None
    """Whether the graph's lists overflowed, or it gave other bits than an eager call; None where there is no graph."""
    checked: str
    """What was compared with the float64 kernels: "all" of the picture, or a "crop" of the first view."""
    max_abs: float
    most_abs: float
    """Largest errors of the compared pixels, and of 99.99 % of them."""
    not_captured: str
    """Why there is no graph; "" where there is one."""
    device: str
    seed: int
    commit: str
    versions: str

    @property
    def amount(self) -> int:
        """What grows along the axis."""
        return {"gaussians": self.gaussians, "pixels": self.width * self.height, "views": self.views}.get(self.axis, 1)

    @property
    def cost_ms(self) -> float:
        """GPU time where it was measured, else time on the host's clock."""
        return self.wall_ms if self.busy_ms is None else self.busy_ms


def points(quick: bool) -> list[Point]:
    """1,000 to 10 million Gaussians, 128 to 4096 pixels a side, 1 to 64 views, two scenes apart; fewer if `quick`."""
    many = (1_000, 3_000, 10_000, 30_000) if quick else [round(10 ** (3 + k / 2)) for k in range(9)]
    sides = (128, 256, 512) if quick else (128, 256, 512, 1024, 2048, 4096)
    crowds = (37_000,) if quick else (37_000, 1_000_000)
    views = (1, 2, 4) if quick else (1, 2, 4, 8, 16, 32, 64)
    size = 256 if quick else 512

    def on_surface(n: int, side: int, n_views: int) -> Callable[[int], GaussianScene]:
        return lambda seed: surface(n, side, n_views, seed)

    return [
        *(Point("gaussians", f"{size} x {size}", on_surface(n, size, 1)) for n in many),
        *(Point("pixels", f"{n:,} Gaussians", on_surface(n, side, 1)) for n in crowds for side in sides),
        *(Point("views", f"37,000 Gaussians at {size} x {size}", on_surface(37_000, size, n)) for n in views),
        Point("stress", "one tile", lambda seed: one_tile(10_000 if quick else 100_000, size, seed)),
        Point("stress", "giants", lambda seed: giants(100 if quick else 1_000, size, seed)),
    ]


def measure_scaling(
    chosen: Sequence[Point],
    device: torch.device,
    *,
    seconds: float,
    seed: int = 0,
    progress: Progress = silent,
) -> list[ScalingRow]:
    """Two rows per point, a forward pass and one with a backward pass.

    Args:
        chosen: Points of `points` to measure.
        device: Where to compute.
        seconds: Limit for timing a point; slow calls are timed in fewer groups.
        seed: Seed of the scenes.
        progress: Called after every point.
    """
    rows: list[ScalingRow] = []
    for done, point in enumerate(chosen):
        rows += measure_point(point, device, seconds, seed)
        progress("scaling", done + 1, len(chosen))
    return rows


def measure_point(point: Point, device: torch.device, seconds: float, seed: int) -> list[ScalingRow]:
    """Both passes of one point."""
    scene = point.make(seed).to(device=device)
    work = count(scene)
    generator = torch.Generator().manual_seed(seed)
    shape = len(scene.viewmats), scene.height, scene.width, 3
    signs = (torch.randint(0, 2, shape, generator=generator, dtype=torch.int8) * 2.0 - 1).to(device)
    rows, error = [], None
    for pass_ in PASSES:
        run = one_pass(RASTERIZATION, RASTERIZATION.call, scene, pass_, UNVALIDATED, (signs,))
        for _ in range(SETTLED):
            found = run()
        finite = all(bool(t.isfinite().all()) for t in found.tensors)
        error = error or picture_errors(scene, found.values[0], work)
        del found
        memory = peak_megabytes(run, device)
        times = timed(run, device, seconds / len(PASSES))
        rows.append(
            ScalingRow(
                axis=point.axis,
                series=point.series,
                scene=scene.name,
                pass_=pass_,
                gaussians=len(scene.means),
                views=work.views,
                width=scene.width,
                height=scene.height,
                pairs=work.pairs,
                longest=work.longest,
                wall_ms=times.wall_ms,
                busy_ms=times.busy_ms,
                peak_mb=memory,
                finite=finite,
                overflow=times.overflow,
                checked=error[0],
                max_abs=error[1],
                most_abs=error[2],
                not_captured=times.reason,
                seed=seed,
                **provenance(device),
            )
        )
    return rows


class Times(NamedTuple):
    """Fields of `ScalingRow`."""

    wall_ms: float
    busy_ms: float | None
    overflow: bool | None
    reason: str


def timed(run: Callable[[], Results], device: torch.device, seconds: float) -> Times:
    """Time a call on the host's clock and, on CUDA, in a graph."""
    captured, reason = None, "no CUDA device"
    if device.type == "cuda":
        start = time.perf_counter()
        run()
        synchronise()
        long = time.perf_counter() - start > seconds / (4 * GRAPH_CALLS)
        try:
            captured, reason = capture(run, 1 if long else GRAPH_CALLS), ""
        except NotCaptured as error:
            reason = str(error)
    if captured is None:
        (wall,) = time_groups([Probe(run)], GROUPS, seconds)
        return Times(wall.median_ms, None, None, reason)
    wall, busy = time_groups([Probe(run), captured.probe()], GROUPS, seconds)
    same = same_bits(captured.results.tensors, run().tensors)
    synchronise()
    return Times(wall.median_ms, busy.median_ms, captured.overflow.happened() or not same, reason)


def picture_errors(scene: GaussianScene, image: Float[Tensor, "C H W 3"], work: Counts) -> tuple[str, float, float]:
    """What was compared with the float64 kernels, its largest error, and that of 99.99 % of its pixels."""
    if work.pairs * 64 <= AFFORDABLE[scene.means.device.type]:
        exact = draw_exactly(scene)
        return "all", float((image.double() - exact).abs().max()), most_error(image, exact)
    # Compare where the image differs most from its background.
    side = CROP + 2 * RIM
    shown = (image[0] - scene.backgrounds[0]).abs().sum(-1)
    coarse = torch.nn.functional.avg_pool2d(shown[None, None], CROP, ceil_mode=True)[0, 0]
    row, column = divmod(int(coarse.argmax()), coarse.shape[1])
    top = max(0, min(CROP * row, scene.height - CROP))
    left = max(0, min(CROP * column, scene.width - CROP))
    part = crop(scene, left - RIM, top - RIM, side)
    exact = draw_exactly(part.subset(reaching(part)))[:, RIM:-RIM, RIM:-RIM]
    got = image[:1, top : top + CROP, left : left + CROP]
    return "crop", float((got.double() - exact).abs().max()), most_error(got, exact)


def draw_exactly(scene: GaussianScene) -> Float[Tensor, "C H W 3"]:
    """The picture by the float64 kernels, view after view."""
    wide = (view.to(dtype=torch.float64) for view in scene.views())
    return torch.cat([forward(RASTERIZATION.call, view, UNVALIDATED)[0] for view in wide])


@torch.no_grad()
def reaching(scene: GaussianScene) -> Tensor:
    """Indices of the Gaussians that the first view shows, in order."""
    _, _, meta = rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors[:, :1], scene.viewmats, scene.Ks,
        scene.width, scene.height, validate=False,
    )  # fmt: skip
    return (meta["radii"][0] > 0).all(-1).nonzero()[:, 0]


@dataclass(frozen=True)
class Growth:
    """The steepest step along one line of the study."""

    axis: str
    series: str
    pass_: str
    ratio: float
    """Growth of the time over that of what grows; 1 is in proportion, less is better than that."""
    before: int
    after: int
    """Amounts between which it is."""

    @property
    def cliff(self) -> bool:
        """Whether the time grows clearly faster than the work."""
        return self.ratio > CALM


def steepest(rows: Sequence[ScalingRow]) -> list[Growth]:
    """For each line of the study the step at which the time grows most for what is added."""
    lines: dict[tuple[str, str, str], list[ScalingRow]] = {}
    for row in rows:
        if row.axis != "stress":
            lines.setdefault((row.axis, row.series, row.pass_), []).append(row)
    found = []
    for key, line in lines.items():
        steps = [
            Growth(*key, (b.cost_ms / a.cost_ms) / (b.amount / a.amount), a.amount, b.amount)
            for a, b in itertools.pairwise(sorted(line, key=lambda row: row.amount))
        ]
        found += [max(steps, key=lambda step: step.ratio)] if steps else []
    return found
