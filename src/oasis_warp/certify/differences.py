"""Gradients against finite differences of the same float64 operator.

Four points along a random direction of one input, (8 (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12 h, of a randomly signed
sum of everything that does not hang on rounding; what does is left out before differencing, with a margin much wider
than the step.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from oasis_warp.certify.case import Case
from oasis_warp.certify.compare import Measurement, weighings
from oasis_warp.certify.families import Family

STEP = 1e-5
"""In units of the input's root mean square: 1e-3 crosses thresholds, 1e-7 leaves 4e-8 of rounding."""
SLACK = 10.0
"""Times the margins of float32 rounding: a step moves a layer's alpha by 1e-4 of itself, less than 10 times 3e-4."""
BOUND = 1e-8


def finite_differences(family: Family, case: Case, device: torch.device, n_directions: int = 3) -> list[Measurement]:
    """The worst direction of every wanted input."""
    exact = case.arguments(torch.float64, torch.device("cpu"))
    outputs, keep = family.twin(case, exact, SLACK)
    (signs, *_) = weighings(case, outputs, keep)
    # A step may leave the range that is accepted: an opacity of 1 grows.
    arguments = case.arguments(torch.float64, device) | {"validate": False}
    signs = [sign.to(device) for sign in signs]

    def total() -> Tensor:
        answers = family.read(family.call(arguments))
        return torch.stack([(out * sign).sum() for out, sign in zip(answers, signs, strict=True)]).sum()

    inputs = [arguments[name] for name in case.wanted]
    gradients = torch.autograd.grad(total(), inputs, allow_unused=True, materialize_grads=True)
    draw = torch.Generator().manual_seed(case.seed)
    found = []
    for name, tensor, gradient in zip(case.wanted, inputs, gradients, strict=True):
        floor = case.floors.get(name, 0.0)
        errors = [directional_error(total, tensor, gradient, floor, draw) for _ in range(n_directions)]
        found.append(Measurement(family.name, "finite differences", f"{case}: {name}", worst(errors), BOUND))
    return found


def worst(errors: list[float]) -> float:
    """The largest; NaN if there is one."""
    return math.nan if any(map(math.isnan, errors)) else max(errors)


@torch.no_grad()
def directional_error(
    function: Callable[[], Tensor], tensor: Tensor, gradient: Tensor, floor: float, draw: torch.Generator
) -> float:
    """Error of the derivative along a random direction, relative to what its terms are apart from their signs."""
    size = tensor.square().mean().sqrt()
    direction = torch.randn(tensor.shape, generator=draw, dtype=torch.float64).to(tensor.device) * size
    place = tensor.detach().clone()

    def at(step: float) -> float:
        tensor.copy_(place + step * direction)
        return float(function())

    differences = [at(step * STEP) - at(-step * STEP) for step in (1.0, 2.0)]
    tensor.copy_(place)
    numeric = (8 * differences[0] - differences[1]) / (12 * STEP)
    terms = gradient * direction
    size = max(abs(numeric), float(terms.norm()), floor * float(direction.norm()))
    error = abs(numeric - float(terms.sum()))
    return error / size if size > 0 else error
