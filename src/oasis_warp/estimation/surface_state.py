"""The fit's state of a surface that is there already: turn, place and angles from where its vertices lie."""

from typing import NamedTuple

import cv2
import numpy as np

from oasis_warp.estimation.fit_state import FitState
from oasis_warp.hand.kinematics import HandKinematics

_EVERY = 16
"""One vertex of so many speaks for the surface."""
_SIGMA = 1e-3
"""Of a vertex about the model [m]; three times as far off it counts as an outlier."""
_ANGLE = 2.0
"""Of angles about rest: holds those that no vertex tells [rad]."""
_SILENT = 2e-3
"""Shape coefficients that move the surface less than this are held near zero [m, over all of it]."""
_OWN = 0.9
"""Share of a bone, of the largest that any vertex has, from which a vertex turns as the bone does."""
_STEPS, _TOLERANCE = 25, 1e-4


class SurfaceState(NamedTuple):
    """A posed surface as the model in a state, and what the model lacks."""

    state: FitState
    detail: np.ndarray
    """Displacement of the model's rest surface that goes beyond shape and pose correctives [m], [V, 3]."""


def shape_of(rig: HandKinematics, rest: np.ndarray) -> np.ndarray:
    """The shape coefficients whose surface at rest comes nearest to `rest` ([V, 3], metres)."""
    basis = rig.shape_basis.reshape(-1, rig.shape_basis.shape[2])
    held = _SILENT**2 * np.eye(basis.shape[1])
    return np.linalg.solve(basis.T @ basis + held, basis.T @ (rest - rig.template).ravel())


def state_of_surface(
    rig: HandKinematics, shape: np.ndarray, rest: np.ndarray, posed: np.ndarray, focal: float, centre: np.ndarray
) -> SurfaceState:
    """The state of that shape in which `rest` comes nearest to `posed`.

    Robust least squares over turn, place and the 26 angles. With the returned detail the model is `posed` exactly.

    Args:
        rig: The model.
        shape: Coefficients, [S], as `shape_of` finds them.
        rest: Surface at rest [m], [V, 3].
        posed: The same surface in the camera's frame [m], [V, 3].
        focal: Of the camera [px].
        centre: Its principal point [px], [2].
    """
    own = rest - rig.rest_surface(shape)
    state = _placed(rig, rest, posed, shape, focal, centre)
    system = _System(rig, posed, own)
    residual, slope = system(state)
    damping = 1e-3
    for _ in range(_STEPS):
        normal = slope.T @ slope
        step = np.zeros(7 + len(rig.dofs) + len(shape))
        step[: slope.shape[1]] = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope.T @ residual)
        trial = state.moved(step)
        next_residual, next_slope = system(trial)
        before, after = float(residual @ residual), float(next_residual @ next_residual)
        if not after < before:
            damping *= 5
            continue
        state, residual, slope = trial, next_residual, next_slope
        damping = max(damping / 3, 1e-7)
        if before - after < _TOLERANCE * before:
            break
    return SurfaceState(state, _detail(rig, state, posed))


class _System:
    """Weighted distances of some vertices from where they should be, and their derivatives."""

    def __init__(self, rig: HandKinematics, posed: np.ndarray, own: np.ndarray):
        self.rig, self.own = rig, own
        self.index = np.arange(0, len(posed), _EVERY)
        self.goal = posed[self.index]

    def __call__(self, state: FitState) -> tuple[np.ndarray, np.ndarray]:
        rig, n = self.rig, len(self.rig.dofs)
        displaced = rig.correctives(rig.all_angles(state.angles)) + self.own
        chain = rig.chain(state.angles, state.shape)
        points = state.linearize(*rig.vertices(chain, state.shape, self.index, displaced))
        error = (points.seen - self.goal) / _SIGMA
        weight = (1 + (error**2).sum(1) / 9) ** -0.25
        slope = (points.d_seen * (weight / _SIGMA)[:, None, None]).reshape(-1, points.d_seen.shape[2])[:, : 6 + n]
        held = np.eye(6 + n)[6:] / _ANGLE
        return np.r_[(error * weight[:, None]).ravel(), state.angles / _ANGLE], np.r_[slope, held]


def _placed(
    rig: HandKinematics, rest: np.ndarray, posed: np.ndarray, shape: np.ndarray, focal: float, centre: np.ndarray
) -> FitState:
    """The palm where it is, and every bone turned against its parent as the flesh around both is."""
    owned = rig.weights > _OWN * rig.weights.max(0)
    turns = [_turn_of(rest[own], posed[own]) for own in owned.T]
    against = [cv2.Rodrigues(turns[parent].T @ turn)[0][:, 0] for parent, turn in zip(rig.parents, turns, strict=True)]
    angles = np.array([against[joint] @ rig.axes[joint, axis] for joint, axis in rig.dofs])
    x, y, z = (posed - rest @ turns[0].T)[owned[:, 0]].mean(0)
    return FitState(turns[0], np.array([x / z, y / z, np.log(z)]), angles, shape, focal, centre)


def _turn_of(rest: np.ndarray, posed: np.ndarray) -> np.ndarray:
    """Rotation that carries some vertices best to where they are (Kabsch 1976)."""
    u, _, vt = np.linalg.svd((posed - posed.mean(0)).T @ (rest - rest.mean(0)))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def _detail(rig: HandKinematics, state: FitState, posed: np.ndarray) -> np.ndarray:
    chain = rig.chain(state.angles, state.shape)
    turn = state.turn @ rig.blended(chain)
    gap = posed - state.in_camera(rig.surface(chain, state.angles, state.shape))
    return np.linalg.solve(turn, gap[..., None])[..., 0]
