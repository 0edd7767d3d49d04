"""How fast every operator is: beside a yardstick, its generic kernels and the same in torch, in one run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from oasis_warp.bench.knobs import DEFAULT, GENERIC, TORCH, Setting, measure_settings_of
from oasis_warp.bench.operators import Operator, Pass
from oasis_warp.bench.rows import provenance, scene_columns
from oasis_warp.bench.scenes import GaussianScene, MeshScene, hand_scenes, surfels
from oasis_warp.core.logging import Progress, silent


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


def ways(operator: Operator, device: torch.device) -> dict[str, Setting]:
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
    named = ways(operator, options.device)
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
