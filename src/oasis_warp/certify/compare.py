"""Values and gradients of an operator on one scene, and how far they are from those of its reference."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_warp.certify.case import Case
from oasis_warp.certify.families import Family, Outputs

FEW_ROWS = 3
"""A scene with so few rows in an input gets `LOSSES` random losses: the gradient of one may cancel to nothing."""
LOSSES = 4
LAYER = 6e-3
"""Largest error of a value that depends on rounding, of 1: one layer of 1/255, and a little."""
NEARLY = 2e-5
"""Difference of two pixels that rounding explains, over the largest element."""
SHARE = 1e-4
"""Share of elements that may differ by more: those where rounding decides what is drawn."""
CPU = torch.device("cpu")


class Measurement(NamedTuple):
    """One number that has to stay below another."""

    family: str
    check: str
    scene: str
    error: float
    bound: float

    @property
    def passed(self) -> bool:
        """NaN fails."""
        return self.error <= self.bound

    @property
    def load(self) -> float:
        """Error over bound; infinite for NaN and for any error where the bound is 0."""
        if math.isnan(self.error):
            return math.inf
        return self.error / self.bound if self.bound > 0 else (math.inf if self.error > 0 else 0.0)


class Answer(NamedTuple):
    """What an operator or its reference computes on one scene."""

    outputs: Outputs
    gradients: list[dict[str, Tensor]]
    """By input, for each loss."""

    def n_not_finite(self) -> int:
        """How many numbers are NaN or infinite."""
        tensors = [*self.outputs, *(g for by_input in self.gradients for g in by_input.values())]
        return sum(int((~t.isfinite()).sum()) for t in tensors)


def loss_weights(case: Case, outputs: Outputs, mask: Outputs) -> list[list[Tensor]]:
    """For each loss, random signs for every unmasked element of every output."""
    few = any(0 < len(case.floats[name]) <= FEW_ROWS for name in case.differentiable)
    g = torch.Generator().manual_seed(case.seed)
    return [
        [(2.0 * torch.randint(2, out.shape, generator=g) - 1) * m for out, m in zip(outputs, mask, strict=True)]
        for _ in range(LOSSES if few else 1)
    ]


def gradients(case: Case, arguments: dict[str, Any], outputs: Outputs, weights: list[list[Tensor]]) -> list[dict]:
    """Gradients of the weighted sums of the outputs, by input; zeros where the outputs do not depend on one."""
    inputs = [arguments[name] for name in case.differentiable]
    taken = []
    for signs in weights if inputs else []:
        terms = [(out * sign.to(out.device)).sum() for out, sign in zip(outputs, signs, strict=True)]
        loss = torch.stack(terms).sum()
        found = [torch.zeros_like(tensor) for tensor in inputs]
        if loss.requires_grad:
            found = torch.autograd.grad(loss, inputs, retain_graph=True, allow_unused=True, materialize_grads=True)
        taken.append({k: g.detach().double().cpu() for k, g in zip(case.differentiable, found, strict=True)})
    return taken


def run_reference(family: Family, case: Case) -> tuple[Answer, Outputs, list[list[Tensor]]]:
    """The answer of the reference, the mask of what counts of it, and the weights of the losses."""
    arguments = case.arguments(torch.float64, CPU)
    outputs, mask = family.reference(arguments, 1.0)
    weights = loss_weights(case, outputs, mask)
    answer = Answer(tuple(o.detach() for o in outputs), gradients(case, arguments, outputs, weights))
    return answer, mask, weights


def run_operator(
    family: Family, case: Case, weights: list[list[Tensor]], dtype: torch.dtype, device: torch.device
) -> Answer:
    """The answer of the operator."""
    arguments = case.arguments(dtype, device)
    outputs = family.read(family.call(arguments))
    return Answer(tuple(o.detach().cpu() for o in outputs), gradients(case, arguments, outputs, weights))


def relative(got: Tensor, want: Tensor, floor: float = 0.0) -> float:
    """L2 distance over the norm of `want`, or of as many elements of `floor`; the distance itself over zero."""
    size = max(float(want.norm()), floor * want.numel() ** 0.5)
    distance = float((got - want).norm())
    return distance / size if size > 0 else distance


def largest(tensor: Tensor) -> float:
    """Magnitude of the largest element; 0 where there is none."""
    return float(tensor.abs().max()) if tensor.numel() else 0.0


def value_errors(
    family: Family, case: Case, got: Outputs, want: Outputs, mask: Outputs
) -> dict[str, tuple[float, float]]:
    """For each output the relative L2 distance and the largest single difference, over the largest element."""
    errors = {}
    for name, a, b, m in zip(family.outputs, got, want, mask, strict=False):  # some outputs are optional
        a, b = a * m, b * m
        floor = case.floors.get(name, 0.0)
        size = max(largest(b), floor)
        errors[name] = relative(a, b, floor), largest(a - b) / size if size > 0 else largest(a - b)
    return errors


def gradient_errors(case: Case, got: Answer, want: Answer) -> dict[str, float]:
    """Relative L2 distance for each input, over all losses."""

    def stacked(answer: Answer, name: str) -> Tensor:
        return torch.stack([by_input[name] for by_input in answer.gradients])

    names = case.differentiable if want.gradients else ()
    return {name: relative(stacked(got, name), stacked(want, name), case.floors.get(name, 0.0)) for name in names}


def compare(
    family: Family, case: Case, dtype: torch.dtype, device: torch.device, limits: tuple[float, float] | None = None
) -> list[Measurement]:
    """The operator against its reference on one scene: values, peaks, gradients, and what depends on rounding.

    `limits` of values and gradients replace those of the case, which are for float32.
    """
    precision = str(dtype).removeprefix("torch.")
    kind = "" if case.condition == "ordinary" else ", stiff"
    want, mask, weights = run_reference(family, case)
    got = run_operator(family, case, weights, dtype, device)
    bounds = case.bounds
    values_bound, gradients_bound = limits or (bounds.values, bounds.gradients)

    def measured(check: str, what: str, error: float, bound: float) -> Measurement:
        return Measurement(family.name, f"{precision} {check}{kind}", f"{case}: {what}", error, bound)

    found = []
    for name, (error, peak) in value_errors(family, case, got.outputs, want.outputs, mask).items():
        found.append(measured("values", name, error, values_bound))
        if limits is None:
            found.append(measured("single elements", name, peak, bounds.peak))
    for name, error in gradient_errors(case, got, want).items():
        found.append(measured("gradients", name, error, gradients_bound))
    found.append(measured("not finite", "all", float(got.n_not_finite()), 0.0))
    if family.name == "rasterization":
        error = max(
            float(((a - b).abs() * (1 - m)).max()) / (1 + float(b.abs().max()))
            for a, b, m in zip(got.outputs, want.outputs, mask, strict=True)
        )
        found.append(measured("pixels on an edge", "image", error, LAYER))
    return found


def agree(
    family: Family, case: Case, check: str, other: tuple[torch.dtype, torch.device], device: torch.device
) -> list[Measurement]:
    """The float32 operator against the operator in another precision or on another device, on a scene of any size."""
    shapes = tuple(out.detach() for out in family.read(family.call(case.arguments(*other))))
    weights = loss_weights(case, shapes, tuple(torch.ones(()) for _ in shapes))
    want = run_operator(family, case, weights, *other)
    got = run_operator(family, case, weights, torch.float32, device)
    bound = 2 * case.bounds.gradients  # both sides may be off
    found = []
    for name, a, b in zip(family.outputs, got.outputs, want.outputs, strict=False):
        off = ((a - b).abs() > NEARLY * largest(b)).double().mean()
        found.append(Measurement(family.name, f"{check}: values off", f"{case}: {name}", float(off), SHARE))
    for name, error in gradient_errors(case, got, want).items():
        found.append(Measurement(family.name, f"{check}: gradients", f"{case}: {name}", error, bound))
    return found
