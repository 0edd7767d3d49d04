"""Damped, robust nonlinear least squares: the solver of the landmark fit, the surface fit and the joint refinement.

Levenberg-Marquardt (Nocedal and Wright 2006, section 10.3) on iteratively reweighted residuals. The loss functions give
the weights of the normal equations and the robust cost by which a step is accepted.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

State = TypeVar("State")
Values = TypeVar("Values", np.ndarray, Tensor)


class QuadraticModel(NamedTuple):
    """The cost near a state, as a function of a step of N unknowns."""

    cost: float
    """Robust cost of the state."""
    normal: np.ndarray
    """J^T J of the weighted residuals, [N, N]."""
    gradient: np.ndarray
    """J^T r of the weighted residuals, [N]."""


class Damping(NamedTuple):
    """Schedule of the damping, a factor of the diagonal of the normal matrix."""

    start: float
    grow: float
    """Factor after a rejected step."""
    shrink: float
    """Divisor after an accepted step."""
    least: float
    floor: float = 0.0
    """Added to the diagonal before it is scaled."""


def minimize(
    state: State,
    model: Callable[[State], QuadraticModel],
    move: Callable[[State, np.ndarray], State],
    damping: Damping,
    iterations: int,
    trials: int,
    tolerance: float,
    cost: Callable[[State], float] | None = None,
) -> tuple[State, float]:
    """The state with the least robust cost, and that cost; a step is accepted only if it lowers the cost.

    Comparing the reweighted sums of squares instead would reward outliers, because their weights fall.

    Args:
        state: Start.
        model: Linearizes the residuals at a state.
        move: A state and a step to the next state; it may shorten the step.
        damping: Schedule of the damping.
        iterations: Steps that are accepted at most.
        trials: Dampings that are tried for each step.
        tolerance: Relative decrease of the cost below which the iteration ends.
        cost: Cost of a trial state, where that is cheaper than `model`.
    """
    factor, at, value = damping.start, None, np.inf
    for _ in range(iterations):
        at = at or model(state)
        value = at.cost
        ahead = None
        for _ in range(trials):
            damped = at.normal + factor * np.diag(np.diag(at.normal) + damping.floor)
            trial = move(state, -np.linalg.solve(damped, at.gradient))
            ahead = model(trial) if cost is None else None
            trial_cost = ahead.cost if ahead is not None else cost(trial)  # pyright: ignore[reportOptionalCall]
            if trial_cost < at.cost:
                break
            factor *= damping.grow
        else:
            break
        settled = at.cost - trial_cost < tolerance * at.cost
        state, value, at = trial, trial_cost, ahead
        factor = max(factor / damping.shrink, damping.least)
        if settled:
            break
    return state, value


def charbonnier(squared: Values, scale: float) -> tuple[Values, Values]:
    """Weights and losses of squared residuals, in units of sigma; linear beyond `scale` sigmas."""
    root = (1 + squared / scale**2) ** 0.5
    return 1 / root, 2 * scale**2 * (root - 1)


def cauchy(squared: Values, scale: float) -> tuple[Values, Values]:
    """Weights and losses of squared residuals, in units of sigma; logarithmic beyond `scale` sigmas."""
    share = squared / scale**2
    logarithm = torch.log1p(share) if isinstance(share, Tensor) else np.log1p(share)
    return 1 / (1 + share), scale**2 * logarithm
