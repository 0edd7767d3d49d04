"""Values and gradients of one scene, here and there, and how far apart they are."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_warp.certify.case import Case
from oasis_warp.certify.families import Family, Outputs

LONE = 3
"""A scene with so few rows in an input is weighed `WEIGHINGS` times: one random sum may cancel to nothing."""
WEIGHINGS = 4
LAYER = 6e-3
"""Largest error of a value that hangs on rounding, of 1: one layer of 1/255, and a little."""


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
        """Error over bound; infinite where there is none to divide by, or no error to speak of."""
        if math.isnan(self.error):
            return math.inf
        return self.error / self.bound if self.bound > 0 else (math.inf if self.error > 0 else 0.0)


class Answer(NamedTuple):
    """What an operator or a twin said to one scene."""

    outputs: Outputs
    gradients: list[dict[str, Tensor]]
    """For each weighing, by input."""


def weighings(case: Case, outputs: Outputs, keep: Outputs) -> list[list[Tensor]]:
    """Random signs for every kept element of every output, one list a gradient to take."""
    few = any(0 < len(case.floats[name]) <= LONE for name in case.wanted)
    g = torch.Generator().manual_seed(case.seed)
    return [
        [(2.0 * torch.randint(2, out.shape, generator=g) - 1) * mask for out, mask in zip(outputs, keep, strict=True)]
        for _ in range(WEIGHINGS if few else 1)
    ]


def gradients(case: Case, arguments: dict[str, Any], outputs: Outputs, weights: list[list[Tensor]]) -> list[dict]:
    """Of the weighted sums of the outputs by the wanted inputs; zeros where the answer does not depend on one."""
    inputs = [arguments[name] for name in case.wanted]
    taken = []
    for signs in weights if inputs else []:
        terms = [(out * sign.to(out.device)).sum() for out, sign in zip(outputs, signs, strict=True)]
        loss = torch.stack(terms).sum()
        if loss.requires_grad:
            found = torch.autograd.grad(loss, inputs, retain_graph=True, allow_unused=True)
        else:
            found = [None] * len(inputs)
        filled = (torch.zeros_like(t) if g is None else g for t, g in zip(inputs, found, strict=True))
        taken.append({name: g.detach().double().cpu() for name, g in zip(case.wanted, filled, strict=True)})
    return taken


def ask_twin(family: Family, case: Case, slack: float = 1.0) -> tuple[Answer, Outputs, list[list[Tensor]]]:
    """The twin's answer, what of it is kept, and the weighings to ask the operator with."""
    arguments = case.arguments(torch.float64, torch.device("cpu"))
    outputs, keep = family.twin(case, arguments, slack)
    weights = weighings(case, outputs, keep)
    answer = Answer(tuple(o.detach() for o in outputs), gradients(case, arguments, outputs, weights))
    return answer, keep, weights


def ask_operator(
    family: Family, case: Case, weights: list[list[Tensor]], dtype: torch.dtype, device: torch.device
) -> Answer:
    """The operator's answer."""
    arguments = case.arguments(dtype, device)
    outputs = family.read(family.call(arguments))
    return Answer(tuple(o.detach().cpu() for o in outputs), gradients(case, arguments, outputs, weights))


def relative(got: Tensor, want: Tensor, floor: float = 0.0) -> float:
    """L2 distance over the norm of `want`, or of as many elements of `floor`; the distance itself over zero."""
    size = max(float(want.norm()), floor * want.numel() ** 0.5)
    distance = float((got - want).norm())
    return distance / size if size > 0 else distance


def value_errors(
    family: Family, case: Case, got: Outputs, want: Outputs, keep: Outputs
) -> dict[str, tuple[float, float]]:
    """For each output the relative L2 distance and the largest single difference, over the largest element."""
    errors = {}
    for name, a, b, mask in zip(family.outputs, got, want, keep, strict=False):  # some outputs are optional
        a, b = a * mask, b * mask
        floor = case.floors.get(name, 0.0)
        size = max(largest(b), floor)
        errors[name] = relative(a, b, floor), largest(a - b) / size if size > 0 else largest(a - b)
    return errors


def largest(tensor: Tensor) -> float:
    """Magnitude of the largest element; 0 where there is none."""
    return float(tensor.abs().max()) if tensor.numel() else 0.0


def gradient_errors(case: Case, got: Answer, want: Answer) -> dict[str, float]:
    """Relative L2 distance for each input, over all weighings."""
    return {
        name: relative(
            torch.stack([g[name] for g in got.gradients]),
            torch.stack([g[name] for g in want.gradients]),
            case.floors.get(name, 0.0),
        )
        for name in (case.wanted if want.gradients else ())
    }


def compare(
    family: Family, case: Case, dtype: torch.dtype, device: torch.device, limits: tuple[float, float] | None = None
) -> list[Measurement]:
    """The operator against its twin on one scene: values, peaks, gradients, and what hangs on rounding.

    `limits` of values and gradients stand in for the case's own, which are for float32.
    """
    precision = str(dtype).removeprefix("torch.")
    kind = "" if case.condition == "ordinary" else ", stiff"
    want, keep, weights = ask_twin(family, case)
    got = ask_operator(family, case, weights, dtype, device)
    bounds = case.bounds
    values_bound, gradients_bound = limits or (bounds.values, bounds.gradients)

    def measured(check: str, what: str, error: float, bound: float) -> Measurement:
        return Measurement(family.name, f"{precision} {check}{kind}", f"{case}: {what}", error, bound)

    found = []
    for name, (rel, peak) in value_errors(family, case, got.outputs, want.outputs, keep).items():
        found.append(measured("values", name, rel, values_bound))
        if limits is None:
            found.append(measured("single elements", name, peak, bounds.peak))
    for name, error in gradient_errors(case, got, want).items():
        found.append(measured("gradients", name, error, gradients_bound))
    found.append(measured("not finite", "all", float(unfinished(got)), 0.0))
    if family.name == "rasterization":
        error = max(
            float(((a - b).abs() * (1 - m)).max()) / (1 + float(b.abs().max()))
            for a, b, m in zip(got.outputs, want.outputs, keep, strict=True)
        )
        found.append(measured("pixels on an edge", "image", error, LAYER))
    return found


def unfinished(answer: Answer) -> int:
    """How many numbers are NaN or infinite."""
    tensors = [*answer.outputs, *(g for taken in answer.gradients for g in taken.values())]
    return sum(int((~t.isfinite()).sum()) for t in tensors)


NEARLY = 2e-5
"""Difference of two pixels that rounding explains, over the largest element."""
SHARE = 1e-4
"""Of elements that may differ by more: those on the edge of a decision."""


def agree(
    family: Family, case: Case, check: str, dtype: torch.dtype, there: torch.device, here: torch.device
) -> list[Measurement]:
    """The float32 operator `here` against the operator in `dtype` `there`, on a scene of any size."""
    shapes = tuple(out.detach() for out in family.read(family.call(case.arguments(dtype, there))))
    weights = weighings(case, shapes, tuple(torch.ones(()) for _ in shapes))
    want = ask_operator(family, case, weights, dtype, there)
    got = ask_operator(family, case, weights, torch.float32, here)
    bound = 2 * case.bounds.gradients  # both sides may be off
    found = []
    for name, a, b in zip(family.outputs, got.outputs, want.outputs, strict=False):
        off = ((a - b).abs() > NEARLY * largest(b)).double().mean()
        found.append(Measurement(family.name, f"{check}: values off", f"{case}: {name}", float(off), SHARE))
    for name, error in gradient_errors(case, got, want).items():
        found.append(Measurement(family.name, f"{check}: gradients", f"{case}: {name}", error, bound))
    return found
