"""The state of the fit that explains a given posed surface: rotation, position and angles from its vertices."""

from typing import NamedTuple

import cv2
import numpy as np

from oasis_warp.estimation.fit_problem import FitState
from oasis_warp.estimation.least_squares import Damping, QuadraticModel, charbonnier, minimize
from oasis_warp.hand.kinematics import HandKinematics, rotation_between

_STRIDE = 16
"""Every so many vertices are compared."""
_SIGMA, _SCALE = 1e-3, 3.0
"""Sigma of the distance of a vertex from the model [m], and its robust scale in sigmas (Charbonnier)."""
_ANGLE = 2.0
"""Sigma of the angles about rest, which holds those that no vertex determines [rad]."""
_SILENT = 2e-3
"""Shape coefficients that move the surface less than this are held near zero [m, norm over all vertices]."""
_OWN = 0.9
"""A vertex rotates with a bone if its weight is this fraction of the bone's largest weight."""
_ITERATIONS, _TRIALS, _TOLERANCE = 25, 8, 1e-4
_DAMPING = Damping(start=1e-3, grow=5, shrink=3, least=1e-7)


class SurfaceState(NamedTuple):
    """A posed surface as the model in a state, and what the model lacks."""

    state: FitState
    detail: np.ndarray
    """Displacement of the model's rest surface beyond shape and pose correctives [m], [V, 3]."""


def shape_of(kinematics: HandKinematics, rest: np.ndarray) -> np.ndarray:
    """The shape coefficients whose surface at rest comes nearest to `rest` ([V, 3], metres)."""
    basis = kinematics.shape_basis.reshape(-1, kinematics.shape_basis.shape[2])
    ridge = _SILENT**2 * np.eye(basis.shape[1])
    return np.linalg.solve(basis.T @ basis + ridge, basis.T @ (rest - kinematics.template).ravel())


def state_of_surface(
    kinematics: HandKinematics,
    shape: np.ndarray,
    rest: np.ndarray,
    posed: np.ndarray,
    focal: float,
    centre: np.ndarray,
) -> SurfaceState:
    """The state of that shape in which `rest` comes nearest to `posed`; with the returned detail it is `posed` exactly.

    Robust least squares over rotation, position and the 26 angles.

    Args:
        kinematics: The model.
        shape: Coefficients, [S], as `shape_of` finds them.
        rest: Surface at rest [m], [V, 3].
        posed: The same surface in the camera's frame [m], [V, 3].
        focal: Focal length of the camera [px].
        centre: Its principal point [px], [2].
    """
    own, n_angles = rest - kinematics.rest_surface(shape), len(kinematics.dofs)
    index = np.arange(0, len(posed), _STRIDE)
    prior = np.eye(6 + n_angles)[6:] / _ANGLE

    def model(state: FitState) -> QuadraticModel:
        joints = kinematics.pose_joints(state.angles, state.shape)
        displacement = (kinematics.correctives(joints.angles) + own)[index]
        points = state.linearize(*kinematics.vertices(joints, index, displacement))
        error = (points.seen - posed[index]) / _SIGMA
        weight = charbonnier((error**2).sum(1), _SCALE)[0] ** 0.5
        jacobian = (points.d_seen * (weight / _SIGMA)[:, None, None]).reshape(-1, points.d_seen.shape[2])
        jacobian = np.r_[jacobian[:, : 6 + n_angles], prior]
        residual = np.r_[(error * weight[:, None]).ravel(), state.angles / _ANGLE]
        return QuadraticModel(float(residual @ residual), jacobian.T @ jacobian, jacobian.T @ residual)

    def move(state: FitState, step: np.ndarray) -> FitState:
        return state.moved(np.r_[step, np.zeros(len(shape) + 1)])

    start = _start(kinematics, rest, posed, shape, focal, centre)
    state, _ = minimize(start, model, move, _DAMPING, _ITERATIONS, _TRIALS, _TOLERANCE)
    joints = kinematics.pose_joints(state.angles, state.shape)
    gap = posed - state.in_camera(kinematics.surface(joints))
    detail = np.linalg.solve(state.rotation @ kinematics.blended(joints), gap[..., None])[..., 0]
    return SurfaceState(state, detail)


def _start(
    kinematics: HandKinematics,
    rest: np.ndarray,
    posed: np.ndarray,
    shape: np.ndarray,
    focal: float,
    centre: np.ndarray,
) -> FitState:
    """Every bone rotated against its parent as the vertices of both are."""
    owned = kinematics.weights > _OWN * kinematics.weights.max(0)
    rotations = [rotation_between(rest[own], posed[own]) for own in owned.T]
    relative = [
        cv2.Rodrigues(rotations[parent].T @ rotation)[0][:, 0]
        for parent, rotation in zip(kinematics.parents, rotations, strict=True)
    ]
    angles = np.array([relative[joint] @ kinematics.axes[joint, axis] for joint, axis in kinematics.dofs])
    x, y, z = (posed - rest @ rotations[0].T)[owned[:, 0]].mean(0)
    return FitState(rotations[0], np.array([x / z, y / z, np.log(z)]), angles, shape, focal, centre)
