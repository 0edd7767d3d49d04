"""What an operator must keep besides its values: finite differences, equal bits, and refusals of bad arguments."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from oasis_warp import ops
from oasis_warp.certify.case import Case
from oasis_warp.certify.compare import CPU, Measurement, loss_weights
from oasis_warp.certify.families import Family
from oasis_warp.core.processes import using_threads
from oasis_warp.ops._runtime.declaration import Array
from oasis_warp.reference.errors import same_bits

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
    """Which bad calls are not refused by a ValueError that begins with the argument's name."""
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
