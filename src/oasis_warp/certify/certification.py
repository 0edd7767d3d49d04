"""What `oasis gradcheck` measures, small steps or with `--scenes` a seeded grid on all cores, and its verdict.

Besides its values an operator must keep finite differences, equal bits, and refusals of bad arguments.
"""

import importlib.metadata
import math
import multiprocessing
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, field
from functools import partial
from itertools import count, islice
from typing import Any

import torch
from torch import Tensor

from oasis_warp import ops
from oasis_warp.certify.case import Case
from oasis_warp.certify.compare import CPU, Measurement, agree, compare, loss_weights
from oasis_warp.certify.families import FAMILIES, Family
from oasis_warp.core.processes import using_threads, worker_pool
from oasis_warp.ops._runtime.declaration import Array
from oasis_warp.reference.errors import same_bits

Step = Callable[[], list[Measurement]]

SMALL: dict[str, list[dict[str, Any]]] = {
    "rasterization": [
        *({"name": "ordinary", "mode": mode} for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED")),
        *({"name": "ordinary", "channels": channels} for channels in (1, 32)),
        *({"name": "ordinary", "sh_degree": degree} for degree in (0, 3)),
        {"name": "covariances"},
        {"name": "ordinary", "n_cameras": 3},
        *({"name": name} for name in ("beyond the clamp of the Jacobian", "opaque and wide", "nearly opaque front")),
    ],
    "depth_visibility": [{"name": "ordinary"}, {"name": "closed surface"}, {"name": "through the camera's plane"}],
    "face_rotations": [
        {"name": name}
        for name in ("ordinary", "rigid motion", "root turned by nearly half a turn", "rolled up", "mirrored")
    ],
    "pose_on_mesh": [
        {"name": "ordinary", "law": "sqrt_area"}, {"name": "ordinary", "law": "area"},
        {"name": "ordinary", "law": "none"}, {"name": "opposite signs"}, {"name": "half turns between corners"},
    ],
    "pose_on_mesh_covars": [{"name": name} for name in ("ordinary", "rigid motion", "large bends")],
    "skin": [
        {"name": "ordinary", "rotation_only": rigid, "with_covars": covars}
        for rigid, covars in ((False, True), (True, True), (False, False))
    ],
}  # fmt: skip
"""Scenes for finite differences, a hundred calls each."""
SMALL_SIZES: dict[str, dict[str, Any]] = {
    "rasterization": {"n": 9, "size": (11, 8), "n_cameras": 1},
    "depth_visibility": {"n": 25, "size": (16, 12), "n_points": 30},
    "face_rotations": {"side": 2},
    "pose_on_mesh": {"n": 7},
    "pose_on_mesh_covars": {"side": 2, "n": 7},
    "skin": {"n": 7, "n_joints": 4},
}
STIFF_SEEDS = 3
ORDINARY_SEEDS = 8
REPEATS = 10
FULL_AMONG = 200
EXACT = (1e-9, 1e-8)
"""Values and gradients of the float64 operator: rounding, magnified where a scene divides by little."""
EXACT_STIFF = (1e-9, 1e-7)
CHUNK = 20
"""Scenes that a process gets at a time."""


def small_scenes(family: Family, seed: int) -> Iterator[Case]:
    """The scenes for finite differences: for each kind the first that is smooth."""
    for kind in SMALL.get(family.name, []):
        cases = (family.case(seed=s, **SMALL_SIZES[family.name] | kind) for s in count(seed))
        yield next(case for case in islice(cases, 1000) if family.smooth(case))


def full_scene(family: Family, seed: int) -> Case:
    """The first ordinary scene that reads every optional argument too, with nothing empty and nothing of width one."""
    cases = [family.case("ordinary", s) for s in range(seed, seed + FULL_AMONG)]
    most = max(len(case.floats) + len(case.others) - ("sh_degree" in case.others) for case in cases)
    for case in cases:
        sizes = [size for tensor in case.floats.values() for size in (tensor.numel(), tensor.shape[-1])]
        draws_colors = case.others.get("render_mode", "RGB") in ("RGB", "RGB+D", "RGB+ED")
        plain = draws_colors and "sh_degree" not in case.others
        if min(sizes) > 1 and plain and len(case.floats) + len(case.others) == most:
            return case
    raise AssertionError(f"{family.name}: no full scene among {FULL_AMONG}")


def steps(family: Family, device: torch.device, seed: int) -> Iterator[Step]:
    """All measurements of one operator."""
    for case in small_scenes(family, seed):
        yield partial(finite_differences, family, case, device)
    for s in range(seed, seed + ORDINARY_SEEDS):
        yield partial(compare, family, family.case("ordinary", s), torch.float64, device, EXACT)
        yield partial(compare, family, family.case("ordinary", s), torch.float32, device)
    for name in family.conditions:
        if name != "ordinary":
            for s in range(seed, seed + STIFF_SEEDS):
                yield partial(compare, family, family.case(name, s), torch.float32, device)
            yield partial(compare, family, family.case(name, seed), torch.float64, device, EXACT_STIFF)
    large = family.case("ordinary", seed, **family.large)
    yield partial(agree, family, large, "float32 to float64", (torch.float64, device), device)
    if device.type != "cpu":
        for s in range(seed, seed + ORDINARY_SEEDS):
            other = family.case("ordinary", s, **family.large)
            yield partial(agree, family, other, f"{device.type} against cpu", (torch.float32, CPU), device)
    yield partial(bit_differences, family, large, device, REPEATS)
    yield partial(refusals, family, full_scene(family, seed), device)


def grid_scenes(names: Sequence[str], n: int, seed: int) -> list[tuple[str, int]]:
    """`n` pairs (operator, seed), the operators in turn and each with consecutive seeds."""
    return [(names[i % len(names)], seed + i // len(names)) for i in range(n)]


def check_scene(name: str, seed: int, device: torch.device) -> list[Measurement]:
    """Measurements of one scene of the grid; an exception is a failed one."""
    family = FAMILIES[name]
    case = family.scene(seed)
    try:
        return compare(family, case, torch.float32, device)
    except Exception as error:  # any way to fail is what the grid looks for
        what = f"{case}: {type(error).__name__}: {error}"
        return [Measurement(name, "calls that end in an error", what, math.inf, 0.0)]


def check_scenes(scenes: Sequence[tuple[str, int]], device: str) -> tuple[int, list[Measurement]]:
    """How many scenes there are, and all their measurements."""
    return len(scenes), [m for name, seed in scenes for m in check_scene(name, seed, torch.device(device))]


def run_grid(
    scenes: Sequence[tuple[str, int]], device: torch.device, n_processes: int
) -> Iterator[tuple[int, list[Measurement]]]:
    """How many scenes were checked and what was measured, chunk after chunk as they are done."""
    chunks = [scenes[i : i + CHUNK] for i in range(0, len(scenes), CHUNK)]
    if n_processes == 1:
        for chunk in chunks:
            yield check_scenes(chunk, str(device))
        return
    pool = worker_pool(n_processes)
    try:
        for done in as_completed([pool.submit(check_scenes, chunk, str(device)) for chunk in chunks]):
            yield done.result()
    except BaseException:  # Ctrl-C above all: do not wait for what is being measured
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@dataclass
class Tally:
    """All measurements of one check of one operator."""

    worst: Measurement
    cases: int = 0
    failures: int = 0

    @property
    def passed(self) -> bool:
        """Whether none failed."""
        return self.failures == 0


@dataclass
class Verdict:
    """Tallies by operator and check, in the order of their first measurement, and all failures."""

    rows: dict[tuple[str, str], Tally] = field(default_factory=dict)
    failed: list[Measurement] = field(default_factory=list)
    conditions: dict[tuple[str, str, str], Tally] = field(default_factory=dict)
    """The same for each kind of scene."""

    def add(self, measurements: Iterable[Measurement]) -> None:
        """Count these."""
        for m in measurements:
            _count(self.rows, (m.family, m.check), m)
            _count(self.conditions, (m.family, m.check.removesuffix(", stiff"), m.scene.split(", seed")[0]), m)
            if not m.passed:
                self.failed.append(m)

    @property
    def passed(self) -> bool:
        """Whether something was measured and nothing failed."""
        return bool(self.rows) and not self.failed


def _count(rows: dict, key: tuple[str, ...], m: Measurement) -> None:
    row = rows.setdefault(key, Tally(m))
    row.cases += 1
    row.failures += not m.passed
    if m.load > row.worst.load:
        row.worst = m


def describe_machine(device: torch.device) -> dict[str, Any]:
    """Device and versions that the numbers belong to."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    return {
        "device": f"{device} ({name})",
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": importlib.metadata.version("warp-lang"),
        "threads": torch.get_num_threads(),
    }


def as_table(verdict: Verdict) -> list[dict[str, Any]]:
    """The tallies by check, for JSON."""
    return [_entry({"family": family, "check": check}, row) for (family, check), row in verdict.rows.items()]


def by_condition(verdict: Verdict) -> list[dict[str, Any]]:
    """The tallies by check and kind of scene, for JSON."""
    return [
        _entry({"family": family, "check": check, "condition": condition}, row)
        for (family, check, condition), row in verdict.conditions.items()
    ]


def _entry(key: dict[str, str], row: Tally) -> dict[str, Any]:
    return key | {
        "error": row.worst.error,
        "bound": row.worst.bound,
        "where": row.worst.scene,
        "cases": row.cases,
        "failures": row.failures,
    }


STEP = 1e-5
"""In units of the input's root mean square: 1e-3 crosses thresholds, 1e-7 leaves 4e-8 of rounding."""
SLACK = 10.0
"""Times the margins of float32 rounding: a step moves a layer's alpha by 1e-4 of itself, less than 10 times 3e-4."""
DIFFERENCES_BOUND = 1e-8
THREADS = (1, 2, 3)
BAD_VALUES = (math.nan, math.inf, -math.inf)


def finite_differences(family: Family, case: Case, device: torch.device, n_directions: int = 3) -> list[Measurement]:
    """Gradients of the float64 operator against finite differences of itself: the worst direction of every input.

    Four points along a random direction of one input, (8 (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12 h, of a randomly
    signed sum of everything that does not depend on rounding, with a margin much wider than the step.
    """
    outputs, mask = family.reference(case.arguments(torch.float64, CPU), SLACK)
    (signs, *_) = loss_weights(case, outputs, mask)
    # A step may leave the range that is accepted: an opacity of 1 grows.
    arguments = case.arguments(torch.float64, device) | {"validate": False}
    signs = [sign.to(device) for sign in signs]

    def total() -> Tensor:
        answers = family.read(family.call(arguments))
        return torch.stack([(out * sign).sum() for out, sign in zip(answers, signs, strict=True)]).sum()

    inputs = [arguments[name] for name in case.differentiable]
    gradients = torch.autograd.grad(total(), inputs, allow_unused=True, materialize_grads=True)
    generator = torch.Generator().manual_seed(case.seed)
    found = []
    for name, tensor, gradient in zip(case.differentiable, inputs, gradients, strict=True):
        floor = case.floors.get(name, 0.0)
        errors = [directional_error(total, tensor, gradient, floor, generator) for _ in range(n_directions)]
        worst = math.nan if any(map(math.isnan, errors)) else max(errors)
        found.append(Measurement(family.name, "finite differences", f"{case}: {name}", worst, DIFFERENCES_BOUND))
    return found


@torch.no_grad()
def directional_error(
    function: Callable[[], Tensor], tensor: Tensor, gradient: Tensor, floor: float, generator: torch.Generator
) -> float:
    """Error of the derivative along a random direction, relative to what its terms are apart from their signs."""
    size = tensor.square().mean().sqrt()
    direction = torch.randn(tensor.shape, generator=generator, dtype=torch.float64).to(tensor.device) * size
    start = tensor.detach().clone()

    def at(step: float) -> float:
        tensor.copy_(start + step * direction)
        return float(function())

    differences = [at(step * STEP) - at(-step * STEP) for step in (1.0, 2.0)]
    tensor.copy_(start)
    numeric = (8 * differences[0] - differences[1]) / (12 * STEP)
    terms = gradient * direction
    size = max(abs(numeric), float(terms.norm()), floor * float(direction.norm()))
    error = abs(numeric - float(terms.sum()))
    return error / size if size > 0 else error


def outputs_and_gradients(
    family: Family, case: Case, device: torch.device, dtype: torch.dtype = torch.float32
) -> list[Tensor]:
    """All tensors of one call, unread."""
    arguments = case.arguments(dtype, device)
    outputs = [out for out in family.call(arguments) if isinstance(out, Tensor)]
    inputs = [arguments[name] for name in case.differentiable]
    generator = torch.Generator().manual_seed(case.seed)
    losses = [
        (out * torch.randn(out.shape, generator=generator, dtype=torch.float64).to(out)).sum()
        for out in outputs
        if out.requires_grad
    ]
    gradients = torch.autograd.grad(torch.stack(losses).sum(), inputs, allow_unused=True) if losses else ()
    return [*(out.detach() for out in outputs), *(g for g in gradients if g is not None)]


def bit_differences(
    family: Family, case: Case, device: torch.device, repeats: int, n_threads: Sequence[int] = THREADS
) -> list[Measurement]:
    """For each number of threads, how many of `repeats` runs differ from the first run of all in any bit."""
    with using_threads(n_threads[0]):
        first = outputs_and_gradients(family, case, device)
    found = []
    for n in n_threads:
        with using_threads(n):
            wrong = sum(not same_bits(first, outputs_and_gradients(family, case, device)) for _ in range(repeats))
        check = "repeats with other bits" if n == n_threads[0] else "thread counts with other bits"
        found.append(Measurement(family.name, check, f"{case}: {repeats} runs on {n} threads", float(wrong), 0.0))
    return found


def refusals(family: Family, case: Case, device: torch.device) -> list[Measurement]:
    """A row for each bad call: 1 where no ValueError that begins with the argument's name refuses it."""
    good = case.arguments(torch.float32, device)
    return [
        Measurement(
            family.name, f"{kind} not refused by name", f"{case}: {name} {what}",
            float(not is_refused(family, good, name, bad)), 0.0,
        )
        for kind, name, what, bad in bad_arguments(family, case, good)
    ]  # fmt: skip


def bad_arguments(family: Family, case: Case, good: dict[str, Any]) -> Iterator[tuple[str, str, str, Tensor]]:
    """(kind of fault, argument, what is wrong with it, its bad value): NaN and Inf, shapes, indices out of range."""
    for name in case.floats:
        for value in BAD_VALUES:
            yield "NaN or Inf", name, f"with {value}", with_middle(good[name], value)
        bad = good[name].detach()[..., :-1] if good[name].dim() > 1 else good[name].detach()[:-1]
        yield "wrong shapes", name, f"of shape {list(bad.shape)}", bad
    inputs = ops.DECLARATIONS[family.name].inputs
    for name, array in inputs.items():
        if array.index and name in good:
            for value in (array.least - 1, axis_size(inputs, good, array.index)):
                yield "wrong indices", name, f"with {value}", with_middle(good[name], value)


def axis_size(inputs: Mapping[str, Array], arguments: Mapping[str, Any], letter: str) -> int:
    """The size of the axis that the declared `inputs` call by this letter."""
    axes = ((arguments.get(name), array.dims) for name, array in inputs.items() if letter in array.dims)
    return next(tensor.shape[dims.index(letter) - len(dims)] for tensor, dims in axes if tensor is not None)


def with_middle(tensor: Tensor, value: float) -> Tensor:
    """A copy with another element in the middle."""
    bad = tensor.detach().clone()
    bad.view(-1)[bad.numel() // 2] = value
    return bad


def is_refused(family: Family, good: dict[str, Any], name: str, bad: Tensor) -> bool:
    """Whether the call with `bad` for one argument is refused by name; of unlike shapes either may be named."""
    blamed = {name} if bad.shape == good[name].shape else set(good)
    try:
        family.call(good | {name: bad})
    except ValueError as error:
        return str(error).split(":")[0] in blamed
    except Exception:  # whatever else a bad argument breaks is what this looks for
        return False
    return False
