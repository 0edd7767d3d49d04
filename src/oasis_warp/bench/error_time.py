"""Error against run time: turn each knob of each operator and see what it costs and what it buys."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from oasis_warp.bench import knobs
from oasis_warp.bench.knobs import Setting
from oasis_warp.bench.operators import OPERATORS, Exact, Operator, Outputs, Pass, exact, forward, gradients
from oasis_warp.bench.rows import Row, commit, device_name, versions
from oasis_warp.bench.scenes import (
    MeshScene,
    Scene,
    equal_depths,
    far_hand,
    hand_scenes,
    layered,
    needles,
    opaque,
    slivers,
)
from oasis_warp.bench.timing import Timed, Timing, peak_megabytes, time_together
from oasis_warp.bench.yardstick import make_yardstick
from oasis_warp.core.logging import Progress, silent
from oasis_warp.ops._runtime.rules import using
from oasis_warp.reference.errors import largest_error, psnr, relative_error, same_bits

SWEPT = ("rasterization", "depth_map", "depth_visibility", "face_rotations", "pose_on_mesh", "skin")
"""Operators that have knobs of their own: `blend_weights` draws by the rasterizer's, posing is two of these."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What to measure."""

    plan: tuple[tuple[Scene | MeshScene, str], ...]
    """Scenes, each with the operator that is measured on it."""
    device: torch.device
    threads: int = 1
    """Of the default setting."""
    max_threads: int = 1
    repeats: int = 20
    settings: Callable[[str, torch.device, int, int], Sequence[Setting]] = knobs.settings


def standard_plan(size: int, seed: int, quick: bool) -> tuple[tuple[Scene | MeshScene, str], ...]:
    """Every operator on the avatar, and each on what is hard for it unless `quick`."""
    drawn, mesh = hand_scenes(size, seed)
    avatar = [(drawn if OPERATORS[name].scene is Scene else mesh, name) for name in SWEPT]
    if quick:
        return tuple(avatar)
    far_drawn, far_mesh = far_hand(size, seed)
    stiff = (
        far_drawn, layered(seed=seed), needles(seed=seed), opaque(seed=seed), equal_depths(seed=seed),
    )  # fmt: skip
    flat = slivers(size, seed)
    return (
        *avatar,
        *((scene, "rasterization") for scene in stiff),
        *((far_mesh, name) for name in ("depth_map", "depth_visibility")),
        *((flat, name) for name in ("face_rotations", "pose_on_mesh")),
    )


def measure(sweep: Sweep, progress: Progress = silent) -> list[Row]:
    """One row a (scene, operator, setting, pass), in this order.

    Args:
        sweep: What to measure.
        progress: Told after every round of timing.
    """
    rows: list[Row] = []
    for place, (scene, op) in enumerate(sweep.plan):

        def after_round(n: int, done: int = place * sweep.repeats) -> None:
            progress("error against time", done + n, len(sweep.plan) * sweep.repeats)

        rows += measure_operator(OPERATORS[op], scene, sweep, after_round)
    return rows


@dataclass(frozen=True)
class Variant:
    """A pass of an operator on a scene with one setting."""

    setting: Setting
    pass_: Pass
    run: Callable[[], Outputs]
    threads: int


def measure_operator(
    operator: Operator, scene: Any, sweep: Sweep, after_round: Callable[[int], object]
) -> list[Row]:
    """Rows of one operator on one scene, all settings timed in turns."""
    scene = scene.to(device=sweep.device)
    truth = exact(operator, scene)
    variants = [
        make_variant(operator, scene, setting, pass_, truth, setting.threads or sweep.threads)
        for setting in sweep.settings(operator.name, sweep.device, sweep.threads, sweep.max_threads)
        for pass_ in operator.passes
    ]
    timings = time_together(
        [Timed(make_yardstick(), 1), *(Timed(v.run, v.threads) for v in variants)], sweep.repeats, after_round
    )
    yardstick, *timings = timings
    results = {(v.setting, v.pass_): v.run() for v in variants}
    floor = reference_floor(operator, scene, truth)
    about = {"commit": commit(), "versions": versions()}
    return [
        make_row(operator, scene, variant, timing, yardstick, truth, results, floor, sweep.device, about)
        for variant, timing in zip(variants, timings, strict=True)
    ]


def make_variant(
    operator: Operator, scene: Any, setting: Setting, pass_: Pass, truth: Exact, threads: int
) -> Variant:
    """The call that is timed; what a setting does to the scene is done before."""
    prepared = setting.prepare(scene)
    call = operator.torch_peer if setting.torch else operator.call
    weights = shaped(truth.weights, setting, prepared)

    def run() -> Outputs:
        with using(setting.rules):
            if pass_ == "forward":
                return forward(call, prepared, setting.options)
            return gradients(operator, call, prepared, setting.options, weights)

    return Variant(setting, pass_, run, threads)


def shaped(weights: Outputs, setting: Setting, prepared: Any) -> Outputs:
    """Weights of the loss in the precision and size of a setting's outputs; of smaller images the first pixels'."""
    cast = tuple(w.to(setting.dtype) for w in weights)
    if setting.shrink == 1:
        return cast
    return tuple(w[:, : prepared.height, : prepared.width].contiguous() if w.dim() == 4 else w for w in cast)


def make_row(
    operator: Operator,
    scene: Any,
    variant: Variant,
    timing: Timing,
    yardstick: Timing,
    truth: Exact,
    results: dict[tuple[Setting, Pass], Outputs],
    floor: float,
    device: torch.device,
    about: dict[str, str],
) -> Row:
    """Errors of one variant beside its times."""
    setting, pass_ = variant.setting, variant.pass_
    raw = results[setting, "forward"]
    outputs = operator.comparable(setting.finish(raw))
    default = next(s for s, _ in results if s.knob == "default")
    same = same_bits(raw, results[default, "forward"])
    gradient_error = None
    if pass_ == "forward + backward":
        found = setting.spread(results[setting, pass_], scene)
        same = same and same_bits(results[setting, pass_], results[default, pass_])
        if found is not None:
            gradient_error = max(relative_error(g, e) for g, e in zip(found, truth.gradients, strict=True))
    each = [(o, e, judged_elements(e, truth.judged)) for o, e in zip(outputs, truth.outputs, strict=True)]
    is_scene = isinstance(scene, Scene)
    return Row(
        scene=scene.name,
        width=scene.width,
        height=scene.height,
        gaussians=len(scene.means if is_scene else scene.quats),
        faces=None if is_scene else len(scene.faces),
        op=operator.name,
        pass_=pass_,
        knob=setting.knob,
        value=setting.value,
        device=device_name(device),
        threads=variant.threads,
        median_ms=timing.median_ms,
        iqr_ms=timing.iqr_ms,
        fastest_ms=timing.fastest_ms,
        repeats=len(timing.times_ms),
        first_ms=timing.first_ms,
        cpu_ms=timing.cpu_ms if device.type == "cpu" else None,
        yardstick_ms=yardstick.cpu_ms,
        peak_mb=peak_megabytes(variant.run, device),
        rel_l2=max(relative_error(o, e, j) for o, e, j in each),
        max_abs=max(largest_error(o, e) for o, e, _ in each),
        psnr_db=psnr(outputs[0], truth.outputs[0]) if operator.image else None,
        gradient_rel_l2=gradient_error,
        floor_rel_l2=floor,
        fragile_percent=truth.fragile_percent,
        bit_equal=same,
        seed=scene.seed,
        **about,
    )


def judged_elements(output: Tensor, judged: Tensor | None) -> Tensor | None:
    """Elements of the judged pixels of an image [1, H, W, D]."""
    return None if judged is None else judged[..., None].expand_as(output)


def reference_floor(operator: Operator, scene: Any, truth: Exact) -> float:
    """Relative difference of the exact first output and that of torch in float64, from a list in another order."""
    other = operator.prepare(knobs.in_other_order(scene.to(dtype=torch.float64)))
    output = operator.comparable(forward(operator.torch_peer, other, {}))[0]
    return relative_error(output, truth.outputs[0], judged_elements(truth.outputs[0], truth.judged))
