"""Shape, pose and camera of a right hand from 21 landmarks and the outline of a mask: damped, robust least squares.

Every residual is divided by its own sigma, so the sigmas are the weights. The metric "world" points of the network
enter as directions of bones only: their size is that of a mean hand, but they halve the error in depth.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from oasis_warp.core.hand_model import KNUCKLES
from oasis_warp.estimation.fit_state import FitState
from oasis_warp.estimation.fit_target import Evidence
from oasis_warp.estimation.landmarks import BONES
from oasis_warp.hand.kinematics import HandKinematics, unit

_PALM = [0, *KNUCKLES]


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Sigmas and scales of the terms; distances in shares of the hand's box (longer side of the landmarks' box)."""

    view_angle: float = np.radians(60.0)
    """Diagonal angle of view of a camera that says nothing about itself."""
    log_focal: float = 0.3
    landmark: float = 0.015
    landmark_scale: float = 3.0
    """Robust scale in sigmas (Charbonnier)."""
    bone: float = 0.45
    """Of unit bone directions."""
    limit: float = 0.05
    """Beyond a pose limit [rad]."""
    coupling: float = 0.35
    """Of end joint = 2/3 middle joint [rad]."""
    angle: tuple[tuple[float, float], ...] = ((1.0, 0.5), (0.25, 0.35), (0.10, 0.25))
    """Of flexion, abduction and twist from the relaxed pose, for fingers and thumb [rad]."""
    relaxed: tuple[float, float, float] = (0.25, 0.45, 0.25)
    """Flexion of a relaxed finger's three joints [rad]."""
    shape: float = 1.0
    silent_shape: float = 0.0003
    """Principal components that move the surface less than this are held: no photo shows them [m, rms]."""
    outline: float = 0.010
    outline_scale: float = 2.0
    """Robust scale in sigmas (Cauchy)."""
    outline_weight: float = 60.0
    """All pairs of the outline together count as this many observations."""


_HELD = 1e-4
"""Sigma of a shape coefficient that is held at its prior."""


@dataclass(frozen=True)
class OutlinePairs:
    """Vertices on the mesh's rim and where along the mask's normal they should lie."""

    vertex: np.ndarray
    target: np.ndarray
    normal: np.ndarray
    trust: np.ndarray
    """Weight of each pair, at most 1."""
    displacement: np.ndarray
    """What the pose correctives added to the rest surface when the pairs were made [m], [V, 3]."""


@dataclass(frozen=True)
class Solution:
    """A fitted state and the robust cost it reached."""

    state: FitState
    cost: float


class Fitter:
    """Fits one hand to the evidence of one photo; `shape` keeps a known person's shape."""

    def __init__(self, rig: HandKinematics, evidence: Evidence, *, settings: FitSettings | None = None,
                 shape: np.ndarray | None = None):  # fmt: skip
        self.rig, self.evidence = rig, evidence
        self.settings = s = settings or FitSettings()
        joint, axis = rig.dofs.T
        finger_flexion = (axis == 0) & (joint < 13)
        self.relaxed = np.where(finger_flexion, np.array(s.relaxed)[(joint - 1) % 3], 0.0)
        self.angle_sigma = np.array(s.angle)[axis, (joint >= 13).astype(int)]
        self.low, self.high = rig.limits[joint, axis].T
        row = {(int(j), int(a)): i for i, (j, a) in enumerate(rig.dofs)}
        self.middle, self.end = (np.array([row[j, 0] for j in joints]) for joints in ((2, 5, 8, 11), (3, 6, 9, 12)))
        self.end_bend = rig.rest_bend[[3, 6, 9, 12]] - 2 / 3 * rig.rest_bend[[2, 5, 8, 11]]
        n_shape = rig.shape_basis.shape[2]
        if shape is None:
            self.shape_mean, self.shape_sigma = np.zeros(n_shape), np.full(n_shape, s.shape)
            principal = np.array([name.startswith("pc") for name in rig.hand.shape_names])
            size = np.sqrt((rig.shape_basis**2).sum(1).mean(0))
            self.shape_sigma[principal & (size < s.silent_shape)] = _HELD
        else:
            self.shape_mean, self.shape_sigma = np.asarray(shape, np.float64), np.full(n_shape, _HELD)
        diagonal = np.hypot(*evidence.size)
        self.focal = evidence.focal or 0.5 * diagonal / np.tan(s.view_angle / 2)
        self.n_angles = len(rig.dofs)
        every = np.arange(6 + self.n_angles + n_shape + (evidence.focal is None))
        self.everything, self.pose_and_camera = every, every[: 6 + self.n_angles]

    # ---- terms

    def system(
        self, state: FitState, *, landmarks: bool = True, robust: bool = True, pairs: OutlinePairs | None = None,
    ) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
        """Weighted residuals, their derivatives by a step, and the robust cost."""
        s, box = self.settings, self.evidence.box
        chain = self.rig.chain(state.angles, state.shape)
        points = state.linearize(*self.rig.landmarks(chain, state.shape))
        n = points.d_image.shape[2]
        residuals, slopes, cost = [], [], 0.0
        if landmarks:
            error = (points.image - self.evidence.xy) / (s.landmark * box)
            weight, loss = _charbonnier((error**2).sum(1), s.landmark_scale if robust else 1e6)
            residuals.append((error * weight[:, None]).ravel())
            slopes.append((points.d_image * (weight / (s.landmark * box))[:, None, None]).reshape(-1, n))
            cost += float(loss.sum())
        for residual, slope in (*self._bone_term(points), *self._priors(state, n)):
            residuals.append(residual)
            slopes.append(slope)
            cost += float(residual @ residual)
        if pairs is not None and len(pairs.vertex):
            rim = state.linearize(*self.rig.vertices(chain, state.shape, pairs.vertex, pairs.displacement))
            error = ((rim.image - pairs.target) * pairs.normal).sum(1) / (s.outline * box)
            weight, loss = _cauchy(error**2, s.outline_scale)
            share = s.outline_weight * pairs.trust / max(pairs.trust.sum(), 1e-9)
            weight = weight * np.sqrt(share)
            residuals.append(error * weight)
            slopes.append(np.einsum("na,nak->nk", pairs.normal * (weight / (s.outline * box))[:, None], rim.d_image))
            cost += float((loss * share).sum())
        return np.concatenate(residuals), np.concatenate(slopes), cost

    def _bone_term(self, points) -> list[tuple[np.ndarray, np.ndarray]]:
        if self.evidence.directions is None:
            return []
        start, end = BONES.T
        bones = points.seen[end] - points.seen[start]
        direction = unit(bones)
        across = np.eye(3) - direction[:, :, None] * direction[:, None]
        across /= np.linalg.norm(bones, axis=1)[:, None, None] * self.settings.bone
        residual = (direction - self.evidence.directions) / self.settings.bone
        return [(residual.ravel(), (across @ (points.d_seen[end] - points.d_seen[start])).reshape(len(BONES) * 3, -1))]

    def _priors(self, state: FitState, n: int) -> list[tuple[np.ndarray, np.ndarray]]:
        s, eye = self.settings, np.eye(n)
        angles = slice(6, 6 + self.n_angles)
        over = np.maximum(state.angles - self.high, 0) + np.minimum(state.angles - self.low, 0)
        bend = state.angles[self.end] - 2 / 3 * state.angles[self.middle] + self.end_bend
        return [
            ((state.angles - self.relaxed) / self.angle_sigma, eye[angles] / self.angle_sigma[:, None]),
            (bend / s.coupling, (eye[6 + self.end] - 2 / 3 * eye[6 + self.middle]) / s.coupling),
            (over / s.limit, eye[angles] * (over != 0)[:, None] / s.limit),
            ((state.shape - self.shape_mean) / self.shape_sigma,
             eye[6 + self.n_angles : -1] / self.shape_sigma[:, None]),
            (np.array([np.log(state.focal / self.focal) / s.log_focal]), eye[-1:] / s.log_focal),
        ]  # fmt: skip

    # ---- solver

    def solve(self, state: FitState, steps: int, free: np.ndarray, *, tolerance: float = 1e-5, **terms) -> Solution:
        """Levenberg-Marquardt over the columns `free`; a step counts only if the robust cost falls.

        Comparing the reweighted sum of squares instead would reward outliers: their weights fall.
        """
        damping = 1e-2
        residual, slope, cost = self.system(state, **terms)
        for _ in range(steps):
            reduced = slope[:, free]
            normal, gradient = reduced.T @ reduced, reduced.T @ residual
            for _ in range(6):
                step = np.zeros(slope.shape[1])
                step[free] = -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-6), gradient)
                step[:3] *= min(1.0, 0.5 / max(float(np.abs(step[:3]).max()), 1e-9))
                trial = state.moved(step)
                next_residual, next_slope, next_cost = self.system(trial, **terms)
                if next_cost < cost:
                    break
                damping *= 4
            else:
                return Solution(state, cost)
            done = cost - next_cost < tolerance * cost
            state, residual, slope, cost = trial, next_residual, next_slope, next_cost
            damping = max(damping / 3, 1e-6)
            if done:
                break
        return Solution(state, cost)

    # ---- stages

    def fit_landmarks(self) -> Solution:
        """Fit to landmarks (and world points, where there are any), from the best of the possible starts."""
        if self.evidence.directions is not None:
            return self._from_start(self._world_start())
        return min((self._from_start(start) for start in self._blind_starts()), key=lambda found: found.cost)

    def refine(self, state: FitState, match: Callable[[FitState], OutlinePairs], rounds: int) -> Solution:
        """Alternate between pairing outlines and three steps of everything."""
        found = Solution(state, np.inf)
        for _ in range(rounds):
            found = self.solve(found.state, 3, self.everything, pairs=match(found.state))
        return found

    def _from_start(self, state: FitState) -> Solution:
        state = self.solve(state, 15, self.pose_and_camera, tolerance=1e-3, robust=False).state
        return self.solve(state, 40, self.everything)

    def _rest_state(self) -> FitState:
        centre = np.array(self.evidence.size) / 2
        return FitState(np.eye(3), np.zeros(3), self.relaxed.copy(), self.shape_mean.copy(), self.focal, centre)

    def _points(self, state: FitState) -> np.ndarray:
        return self.rig.landmarks(self.rig.chain(state.angles, state.shape), state.shape)[0]

    def _placed(self, state: FitState, log_depth: float) -> FitState:
        """`state` at a depth, with the middle of its points on the middle of the landmarks."""
        middle = (self._points(state) @ state.turn.T).mean(0)[:2] / np.exp(log_depth)
        aim = (self.evidence.xy - state.centre).mean(0) / state.focal - middle
        return FitState(state.turn, np.array([*aim, log_depth]), state.angles, state.shape, state.focal, state.centre)

    def _world_start(self) -> FitState:
        """Turn and angles from the bone directions alone, depth from the scale of the world points."""
        e = self.evidence
        assert e.directions is not None and e.pixels_per_metre is not None and e.bone_length is not None
        state = self._rest_state()
        points = self._points(state)
        world = np.zeros((21, 3))
        for (start, end), direction in zip(BONES, e.directions, strict=True):
            world[end] = world[start] + direction * np.linalg.norm(points[end] - points[start])
        turn = _turn_between(points[_PALM], world[_PALM])
        # Bone lengths and not a rigid fit say how large the model is: a bent hand is smaller than the relaxed one.
        length = np.linalg.norm(points[BONES[:, 1]] - points[BONES[:, 0]], axis=1).sum()
        log_depth = float(np.log(state.focal / (e.pixels_per_metre * e.bone_length / length)))
        state = FitState(turn, np.zeros(3), state.angles, state.shape, state.focal, state.centre)
        turn_and_angles = np.r_[0:3, 6 : 6 + self.n_angles]
        state = self.solve(state, 12, turn_and_angles, tolerance=1e-3, landmarks=False).state
        return self._placed(state, log_depth)

    def _blind_starts(self) -> list[FitState]:
        """Starts without world points: palm or back to the camera, upright or tilted, turned as the palm lies."""
        state = self._rest_state()
        points, xy = self._points(state), self.evidence.xy
        starts = []
        for flip in (0.0, np.pi):
            for tilt in (-0.6, 0.0, 0.6):
                # At rest the fingers point to -x and the palm to -y: look at the palm along +y, then tilt about z.
                facing = cv2.Rodrigues(np.array([np.pi / 2 + flip, 0, 0]))[0] @ cv2.Rodrigues(np.array([0, 0, tilt]))[0]
                flat = (points @ facing.T)[:, :2]
                a, b = flat[_PALM] - flat[_PALM].mean(0), xy[_PALM] - xy[_PALM].mean(0)
                angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
                turn = cv2.Rodrigues(np.array([0, 0, angle]))[0] @ facing
                scale = np.sqrt((b**2).sum() / (a**2).sum())
                posed = FitState(turn, np.zeros(3), state.angles, state.shape, state.focal, state.centre)
                starts.append(self._placed(posed, float(np.log(state.focal / scale))))
        return starts


def _charbonnier(squared: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Square root of the reweighting factor, and the loss, of squared errors in sigmas."""
    root = np.sqrt(1 + squared / scale**2)
    return root**-0.5, 2 * scale**2 * (root - 1)


def _cauchy(squared: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    return (1 + squared / scale**2) ** -0.5, scale**2 * np.log1p(squared / scale**2)


def _turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotation that carries the points `a` best onto `b`, after centring (Kabsch 1976)."""
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
