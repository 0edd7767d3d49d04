"""One operator on one scene with several settings: timed in turns, and compared with the exact results."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from oasis_warp.bench.knobs import Setting
from oasis_warp.bench.operators import Exact, Operator, Outputs, Pass, Results, exact, one_pass
from oasis_warp.bench.timing import Timed, make_yardstick, peak_megabytes, time_together


@dataclass(frozen=True)
class Measured:
    """A pass with one setting."""

    setting: Setting
    pass_: Pass
    results: Results
    yardstick_ms: float
    """The yardstick's CPU time in the same rounds: times over it can be compared between runs."""
    columns: dict[str, Any]
    """Those columns of a row that say what was timed, and how long it took."""

    @property
    def cost_ms(self) -> float:
        """What times are compared by."""
        return cost_ms(self.columns["fastest_ms"], self.columns["cpu_ms"], self.columns["threads"])


def cost_ms(fastest: float, cpu: float | None, threads: int) -> float:
    """What times are compared by: CPU time for one thread, else the fastest call.

    Other work on the machine delays a call, but hardly adds to its CPU time.
    """
    return fastest if cpu is None or threads > 1 else cpu


def timed_pass(operator: Operator, scene: Any, setting: Setting, pass_: Pass, truth: Exact, threads: int) -> Timed:
    """The call to time; what a setting does to the scene is done before."""
    prepared = operator.prepare(setting.prepare(scene))
    call = operator.torch_call if setting.torch else operator.call
    weights = fitted(truth.weights, setting, prepared)
    run = one_pass(operator, call, prepared, pass_, setting.options, weights)
    return Timed(run, setting.threads or threads, setting.around)


def fitted(weights: Outputs, setting: Setting, prepared: Any) -> Outputs:
    """Weights of the loss in the precision and size of a setting's outputs; of smaller images the first pixels'."""
    cast = tuple(w.to(setting.dtype) for w in weights)
    if setting.shrink == 1:
        return cast
    return tuple(w[:, : prepared.height, : prepared.width].contiguous() if w.dim() == 4 else w for w in cast)


def measure_settings_of(
    operator: Operator, scene: Any, settings: Sequence[Setting], device: torch.device, threads: int, repeats: int,
    after_round: Callable[[int], object] | None = None,
) -> tuple[Exact, list[Measured]]:  # fmt: skip
    """The exact results of a scene on `device`, and what was measured of every pass with every setting.

    `threads` are those of settings that name none; `after_round` is told the number of finished rounds.
    """
    truth = exact(operator, scene)
    keys = [(setting, pass_) for setting in settings for pass_ in operator.passes]
    calls = [timed_pass(operator, scene, setting, pass_, truth, threads) for setting, pass_ in keys]
    yardstick, *timings = time_together([Timed(make_yardstick(), 1), *calls], repeats, after_round)
    found = []
    for (setting, pass_), call, timing in zip(keys, calls, timings, strict=True):
        with call.ready():
            results, memory = call.run(), peak_megabytes(call.run, device)
        assert isinstance(results, Results)
        columns = {
            "pass_": pass_, "threads": call.threads, "median_ms": timing.median_ms, "iqr_ms": timing.iqr_ms,
            "fastest_ms": timing.fastest_ms, "cpu_ms": timing.cpu_ms if device.type == "cpu" else None,
            "first_ms": timing.first_ms, "repeats": repeats, "peak_mb": memory,
        }  # fmt: skip
        found.append(Measured(setting, pass_, results, yardstick.cpu_ms, columns))
    return truth, found
