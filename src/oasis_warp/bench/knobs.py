"""The knobs of the operators: thresholds, precision, threads, and how much of a scene is drawn.

An operator is timed with several settings in turns on one scene, and compared with the exact results.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from oasis_warp.bench.operators import Exact, Operator, Outputs, Pass, Results, exact, one_pass
from oasis_warp.bench.scenes import GaussianScene, MeshScene
from oasis_warp.bench.timing import Timed, make_yardstick, peak_megabytes, time_together
from oasis_warp.ops._runtime import depth_buffer
from oasis_warp.ops._runtime.rules import Rules, using

RULES = Rules()


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


@dataclass(frozen=True, eq=False)  # a setting equals itself only, and so can be a key
class Setting:
    """One knob at one value, everything else at its default."""

    knob: str
    value: str
    rules: Rules = RULES
    dtype: torch.dtype = torch.float32
    threads: int | None = None
    """None: as many as the run uses."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the operator."""
    share: float = 1.0
    """Share of the Gaussians that is drawn: those with the largest opacity times area on the surface."""
    shrink: int = 1
    """Factor by which each side of the image has fewer pixels."""
    torch: bool = False
    """Whether torch computes it instead of the kernels."""
    generic: bool = False
    """Whether the generic kernels compute it, where vectorised ones would."""

    @contextmanager
    def around(self) -> Iterator[None]:
        """What is set up for every call."""
        with using(self.rules), generic_kernels() if self.generic else nullcontext():
            yield

    def prepare(self, scene: Any) -> Any:
        """The scene to draw with this setting."""
        if self.share < 1:
            scene = scene.subset(most_visible(scene, self.share))
        if self.shrink > 1:
            scene = smaller(scene, self.shrink)
        return scene.to(dtype=self.dtype)

    def finish(self, outputs: Outputs) -> Outputs:
        """Images and maps enlarged to their size without this setting."""
        if self.shrink == 1:
            return outputs
        return tuple(enlarged(output, self.shrink) for output in outputs)

    def spread(self, gradients: Outputs, scene: Any) -> Outputs | None:
        """Gradients by the whole scene, 0 where it was not drawn; None for smaller images, whose loss is another."""
        if self.shrink > 1 and isinstance(scene, GaussianScene):
            return None
        if self.share == 1:
            return gradients
        index, n = most_visible(scene, self.share), len(scene.means)
        return tuple(g.new_zeros(n, *g.shape[1:]).index_copy(0, index, g) for g in gradients)


DEFAULT = Setting("default", "default")
THRESHOLDS = (
    *(Setting("alpha cut", f"{k:g}/255", Rules(alpha_min=k / 255)) for k in (0.5, 2, 4)),
    *(Setting("stop", f"{stop:g}", Rules(transmittance_stop=stop)) for stop in (1e-2, 1e-3, 1e-5)),
    *(Setting("extent", f"{sigmas:g} sigma", Rules(extent_sigmas=sigmas)) for sigmas in (2.0, 2.5, 3.0)),
)
EXPONENTIAL = tuple(Setting("exp degree", str(degree), Rules(exp_degree=degree)) for degree in (3, 4))
"""Degrees of the exponential in the CPU's float32 kernels; CUDA computes exponentials in hardware."""
FLOAT64 = Setting("precision", "float64", dtype=torch.float64)
TORCH = Setting("torch", "float32", torch=True)
GENERIC = Setting("generic", "float32", generic=True)
UNCHECKED = Setting("validate", "False", options={"validate": False})
TILES = tuple(Setting("tile", f"{size} px", options={"tile_size": size}) for size in (8, 32))
GAUSSIANS = tuple(Setting("Gaussians", f"{share:.0%}", share=share) for share in (0.75, 0.5, 0.25))
SIZES = tuple(Setting("resolution", f"1/{k}", shrink=k) for k in (2, 4))


def settings(op: str, device: torch.device, threads: int, max_threads: int) -> tuple[Setting, ...]:
    """The default and all settings worth measuring of an operator; `threads` are those of the default."""
    cpu = device.type == "cpu"
    others = [n for n in (1, 2, 4, 8, 16, 32, 64) if n <= max_threads and n != threads] if cpu else []
    common = (FLOAT64, TORCH, UNCHECKED, *(Setting("threads", str(n), threads=n) for n in others))
    extra = {
        "rasterization": (*THRESHOLDS, *(EXPONENTIAL if cpu else ()), *TILES, *GAUSSIANS, SIZES[0]),
        "depth_map": SIZES,
        "depth_visibility": SIZES,
    }
    return (DEFAULT, *extra.get(op, ()), *common)


def most_visible(scene: GaussianScene, share: float) -> Tensor:
    """Indices, in order, of the `share` of Gaussians with the largest opacity times area of their two longest axes."""
    longest = scene.scales.topk(2, dim=-1).values
    weight = scene.opacities * longest.prod(-1)
    return weight.topk(max(1, round(share * len(weight)))).indices.sort().values


def smaller(scene: GaussianScene | MeshScene, times: int) -> Any:
    """The same view with `times` fewer pixels a side."""
    if scene.width % times or scene.height % times:
        raise ValueError(f"times: expected a divisor of {scene.width} x {scene.height}, got {times}.")
    scaling = scene.viewmats.new_tensor if isinstance(scene, GaussianScene) else scene.viewmat.new_tensor
    scaling = scaling([1 / times, 1 / times, 1.0])[:, None]
    size = {"width": scene.width // times, "height": scene.height // times}
    if isinstance(scene, GaussianScene):
        return replace(scene, Ks=scene.Ks * scaling, **size)
    return replace(scene, K=scene.K * scaling, **size)


def enlarged(output: Tensor, times: int) -> Tensor:
    """An image [1, H, W, D] by bilinear interpolation, a map [H, W] by the nearest pixel; anything else as it is."""
    if output.dim() == 4:
        return interpolate(output.movedim(-1, 1), scale_factor=times, mode="bilinear").movedim(1, -1)
    if output.dim() == 2:
        return output.repeat_interleave(times, 0).repeat_interleave(times, 1)
    return output


def in_other_order(scene: Any) -> Any:
    """The scene with its Gaussians, or its faces, listed in another order that draws the same.

    Gaussians at one depth, which are drawn in the order of the list, keep theirs among each other.
    """
    generator = torch.Generator().manual_seed(scene.seed + 1)
    if isinstance(scene, GaussianScene):
        device = scene.means.device
        depths = scene.means.double() @ scene.viewmats[0, 2, :3].double()
        group = depths.unique(return_inverse=True)[1]
        shuffled = torch.randperm(len(depths), generator=generator).to(device)
        order = torch.empty_like(shuffled)
        order[torch.argsort(group[shuffled], stable=True)] = torch.argsort(group, stable=True)
        return scene.subset(order)
    order = torch.randperm(len(scene.faces), generator=generator).to(scene.faces.device)
    position = torch.empty_like(order)
    position[order] = torch.arange(len(order), device=order.device)
    face_index = position[scene.face_index.long()]
    return replace(scene, faces=scene.faces[order], area_ratio=scene.area_ratio[order], face_index=face_index)


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
