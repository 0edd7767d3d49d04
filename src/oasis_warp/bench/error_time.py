"""Error against run time: what each setting of each operator costs and buys."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from oasis_warp.bench import knobs
from oasis_warp.bench.knobs import Measured, Setting, cost_ms, measure_settings_of
from oasis_warp.bench.operators import OPERATORS, Exact, Operator, Results, forward
from oasis_warp.bench.rows import provenance, scene_columns
from oasis_warp.bench.scenes import (
    GaussianScene,
    MeshScene,
    equal_depths,
    far_hand,
    hand_scenes,
    layered,
    needles,
    opaque,
    slivers,
)
from oasis_warp.core.logging import Progress, silent
from oasis_warp.reference.errors import largest_error, psnr, relative_error, same_bits

SWEPT = ("rasterization", "depth_map", "depth_visibility", "face_rotations", "pose_on_mesh", "skin")
"""Operators with knobs of their own: `blend_weights` draws by the rasterizer's, posing is two of these."""
BUDGETS: tuple[tuple[str, float | None], ...] = (("1e-2", 1e-2), ("1e-3", 1e-3), ("1e-4", 1e-4), ("exact", None))
"""Largest error allowed; None: no more than that of the default, whose arithmetic is exact up to rounding."""
WORTHWHILE = 0.05
"""Least share of the time that a setting has to save: such times differ by less."""


@dataclass(frozen=True, kw_only=True)
class SettingRow:
    """An operator on a scene with one setting. What does not apply is empty in CSV and null in JSON."""

    scene: str
    width: int
    height: int
    gaussians: int
    """In the scene."""
    faces: int | None
    """Faces of the scene's mesh, where it has one."""
    op: str
    pass_: str
    """Called `pass` in files: "forward" or "forward + backward"."""
    knob: str
    value: str
    """Value of the knob; "default" for the knob "default"."""
    device: str
    threads: int
    median_ms: float
    iqr_ms: float
    fastest_ms: float
    repeats: int
    first_ms: float
    """The first call, with compiling or loading kernels."""
    cpu_ms: float | None
    """CPU time of all threads in the call with the least; None on CUDA."""
    yardstick_ms: float
    """The yardstick's CPU time in the same rounds: times over it can be compared between runs."""
    peak_mb: float | None
    """Memory beyond what was in use before the call [MiB]."""
    rel_l2: float
    """Largest relative error of any output, fragile pixels left out."""
    max_abs: float
    """Largest error of any element of any output, fragile pixels included."""
    psnr_db: float | None
    """PSNR of the image, fragile pixels included; None where the image is equal, or there is none."""
    gradient_rel_l2: float | None
    """Largest relative error of any gradient, of a loss without the fragile pixels."""
    floor_rel_l2: float
    """How far the exact results are known: how much torch in float64, with the Gaussians or faces in another order,
    differs from them in the first output. Smaller errors than this say nothing."""
    fragile_percent: float | None
    """Share of the pixels where a decision depends on rounding."""
    bit_equal: bool
    """Whether results and gradients are bit-equal to those of the default setting."""
    seed: int
    commit: str
    versions: str

    @property
    def error(self) -> float:
        """The larger of the errors of values and gradients."""
        return max(self.rel_l2, self.gradient_rel_l2 or 0.0)

    @property
    def cost_ms(self) -> float:
        """What settings are compared by: see `variants.cost_ms`."""
        return cost_ms(self.fastest_ms, self.cpu_ms, self.threads)

    @property
    def is_default(self) -> bool:
        """Whether every knob is at its default."""
        return self.knob == "default"


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What to measure."""

    plan: tuple[tuple[GaussianScene | MeshScene, str], ...]
    """Scenes, each with the operator to measure on it."""
    device: torch.device
    threads: int = 1
    """Threads of the default setting."""
    max_threads: int = 1
    repeats: int = 20
    settings: Callable[[str, torch.device, int, int], Sequence[Setting]] = knobs.settings


def standard_plan(size: int, seed: int, quick: bool) -> tuple[tuple[GaussianScene | MeshScene, str], ...]:
    """Every operator on the avatar and, unless `quick`, on scenes that are hard for it."""
    drawn, mesh = hand_scenes(size, seed)
    avatar = [(drawn if OPERATORS[name].scene is GaussianScene else mesh, name) for name in SWEPT]
    if quick:
        return tuple(avatar)
    far_drawn, far_mesh = far_hand(size, seed)
    stiff = far_drawn, *(make(seed=seed) for make in (layered, needles, opaque, equal_depths))
    flat = slivers(size, seed)
    return (
        *avatar,
        *((scene, "rasterization") for scene in stiff),
        *((far_mesh, name) for name in ("depth_map", "depth_visibility")),
        *((flat, name) for name in ("face_rotations", "pose_on_mesh")),
    )


def measure_settings(sweep: Sweep, progress: Progress = silent) -> list[SettingRow]:
    """One row for each scene, operator, setting and pass, in this order.

    Args:
        sweep: What to measure.
        progress: Called after every round of timing.
    """
    rows: list[SettingRow] = []
    for k, (scene, name) in enumerate(sweep.plan):

        def after_round(n: int, done: int = k * sweep.repeats) -> None:
            progress("error against time", done + n, len(sweep.plan) * sweep.repeats)

        rows += measure_operator(OPERATORS[name], scene, sweep, after_round)
    return rows


def measure_operator(
    operator: Operator, scene: Any, sweep: Sweep, after_round: Callable[[int], object]
) -> list[SettingRow]:
    """Rows of one operator on one scene, all settings timed in turns."""
    scene = scene.to(device=sweep.device)
    settings = sweep.settings(operator.name, sweep.device, sweep.threads, sweep.max_threads)
    truth, found = measure_settings_of(
        operator, scene, settings, sweep.device, sweep.threads, sweep.repeats, after_round
    )
    common = {
        **scene_columns(scene),
        "op": operator.name,
        **provenance(sweep.device),
        "floor_rel_l2": reference_floor(operator, scene, truth),
        "fragile_percent": truth.fragile_percent,
    }
    results = {(m.setting.knob, m.setting.value, m.pass_): m.results for m in found}
    return [
        SettingRow(
            **common,
            **m.columns,
            yardstick_ms=m.yardstick_ms,
            knob=m.setting.knob,
            value=m.setting.value,
            **error_columns(operator, scene, m, truth, results),
        )
        for m in found
    ]


def error_columns(
    operator: Operator, scene: Any, measured: Measured, truth: Exact, results: Mapping[tuple[str, str, str], Results]
) -> dict[str, Any]:
    """The columns of a row that say how exact it is, given the results by knob, value and pass."""
    setting, pass_ = measured.setting, measured.pass_
    raw = results[setting.knob, setting.value, "forward"].values
    usual = (knobs.DEFAULT.knob, knobs.DEFAULT.value)
    finished = setting.finish(raw)
    outputs = operator.comparable(finished)
    same = same_bits(raw, results[*usual, "forward"].values)
    gradient_error = None
    if pass_ == "forward + backward":
        gradients = measured.results.gradients
        found = setting.spread(gradients, scene)
        same = same and same_bits(gradients, results[*usual, pass_].gradients)
        gradient_error = None if found is None else truth.gradient_error(found)
    return {
        "rel_l2": truth.value_error(finished),
        "max_abs": max(largest_error(o, e) for o, e in zip(outputs, truth.values, strict=True)),
        "psnr_db": psnr(outputs[0], truth.values[0]) if operator.image else None,
        "gradient_rel_l2": gradient_error,
        "bit_equal": same,
    }


def reference_floor(operator: Operator, scene: Any, truth: Exact) -> float:
    """Relative difference of the exact first output and that of torch in float64, from a list in another order."""
    other = operator.prepare(knobs.in_other_order(scene.to(dtype=torch.float64)))
    output, exact_output = operator.comparable(forward(operator.torch_call, other, {}))[0], truth.values[0]
    judged = None if truth.judged is None else truth.judged[..., None].expand_as(exact_output)
    return relative_error(output, exact_output, judged)


class Group(NamedTuple):
    """Rows that can be compared: one operator on one scene in one pass."""

    op: str
    scene: str
    pass_: str
    rows: tuple[SettingRow, ...]

    @property
    def default(self) -> SettingRow:
        """The row of the default setting."""
        return next(row for row in self.rows if row.is_default)


def groups(rows: Iterable[SettingRow]) -> list[Group]:
    """Comparable rows, in the order of their first."""
    found: dict[tuple[str, str, str], list[SettingRow]] = {}
    for row in rows:
        found.setdefault((row.op, row.scene, row.pass_), []).append(row)
    return [Group(*key, tuple(members)) for key, members in found.items()]


def fits(row: SettingRow, budget: float | None, default: SettingRow) -> bool:
    """Whether a row keeps an error budget; one whose gradients cannot be compared keeps none of its pass."""
    if row.pass_ != "forward" and row.gradient_rel_l2 is None:
        return False
    return row.bit_equal or row.error <= (default.error if budget is None else budget)


def fastest(group: Group, budget: float | None) -> SettingRow:
    """The setting of least `cost_ms` that keeps an error budget; the default if none gains more than `WORTHWHILE`.

    Threads are not among them: they trade no error, and every setting can have them.
    """
    within = [row for row in group.rows if row.knob != "threads" and fits(row, budget, group.default)]
    best = min(within, key=lambda row: row.cost_ms)
    return best if best.cost_ms < (1 - WORTHWHILE) * group.default.cost_ms else group.default


def non_dominated(rows: Sequence[SettingRow]) -> list[SettingRow]:
    """Rows that no other beats in both time and error, fastest first."""
    best: list[SettingRow] = []
    for row in sorted(rows, key=lambda row: (row.cost_ms, row.error)):
        if not best or row.error < best[-1].error:
            best.append(row)
    return best
