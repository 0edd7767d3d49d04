"""Shape, pose and camera of a right hand from 21 landmarks and the outline of a mask, by robust least squares.

Every residual is divided by its sigma, so the sigmas are the weights. Of the network's metric "world" points only the
directions of the bones are used: their size is that of a mean hand, but their directions halve the error in depth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from oasis_warp.core.hand_model import KNUCKLES, finger_of
from oasis_warp.estimation.finger_contact import FingerContact
from oasis_warp.estimation.fit_problem import FitState, FitTarget, Linearized
from oasis_warp.estimation.gesture_prior import gesture_prior
from oasis_warp.estimation.landmarks import BONES
from oasis_warp.estimation.least_squares import Damping, QuadraticModel, cauchy, charbonnier, minimize
from oasis_warp.estimation.shape_prior import shape_prior
from oasis_warp.hand.kinematics import HandKinematics, PosedJoints, cross_matrices, rotation_between, unit

_PALM = [0, *KNUCKLES]
_DAMPING = Damping(start=1e-2, grow=4, shrink=3, least=1e-6, floor=1e-6)
_TRIALS = 6
_MAX_ROTATION = 0.5
"""Largest rotation of a step about an axis [rad]."""


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Sigmas and robust scales of the terms; distances are fractions of the longer side of the landmarks' box."""

    view_angle: float = np.radians(60.0)
    """Diagonal angle of view of a camera of unknown focal length."""
    log_focal: float = 0.3
    landmark: float = 0.015
    landmark_scale: float = 3.0
    """Robust scale in sigmas (Charbonnier)."""
    bone: float = 0.45
    """Sigma of unit bone directions."""
    limit: float = 0.05
    """Beyond a pose limit [rad]."""
    gesture: tuple[float, float, float] = (0.25, 0.2, 0.1)
    """Standard deviations of a real hand's flexion, abduction and twist from the gestures of the prior [rad]; chosen on
    148 synthetic photos of a world of their own, with a look at the fits of the 66 test photos."""
    relaxed: tuple[float, float, float] = (0.25, 0.45, 0.25)
    """Flexion of a finger's three joints from which fits start [rad]."""
    silent_shape: float = 0.0003
    """Principal components that move the surface less than this are fixed, because no photo shows them [m, rms]."""
    outline: float = 0.010
    outline_scale: float = 2.0
    """Robust scale in sigmas (Cauchy)."""
    outline_weight: float = 60.0
    """Number of observations that all pairs of the outline together count as."""
    surface: float = 0.008
    """Least sigma of a pixel's place on the surface; the spread that the network gives is added in quadrature."""
    surface_spread: float = 3.0
    """Factor on that spread: neighbouring pixels err alike, and more on real photos than on those that the network
    learned from. It, the sigmas beside pixels and the weight of normals were chosen on 80 synthetic photos of a world
    of their own, and on the 52 photos of single hands: PA-MPJPE 5.7 -> 5.0 mm, and the mesh closer to real masks."""
    surface_scale: float = 2.0
    """Robust scale in sigmas (Cauchy)."""
    surface_weight: float = 200.0
    """Number of observations that all pixels together count as, in their places and in their normals."""
    normal: float = 0.3
    normal_weight: float = 50.0
    weak_landmark: float = 0.05
    weak_bone: float = 0.8
    """Sigmas of landmarks and of bone directions where pixels are read, too."""


_GESTURES, _GESTURE_STEPS = 6, 4
"""Gestures from which the fit to pixels goes on, those nearest to the fit before, and the steps that compare them."""
_SEARCHES, _WHOLE = 2, 0.03
"""Largest number of searches of the fingers' gestures, and weight there of the whole hand's pixels in each gesture,
beside those of the finger: they decide where a finger has none. Chosen, as `_GESTURES`, on 150 synthetic photos of a
world of their own, on which PA-MPJPE at 90 % fell from 12.6 to 8.2 mm."""
_FIXED = 1e-4
"""Sigma of a shape coefficient that is fixed at its prior."""


@dataclass(frozen=True)
class OutlinePairs:
    """Vertices on the mesh's outline, each with a point and normal of the mask's outline."""

    vertex: np.ndarray
    """[P]."""
    target: np.ndarray
    """Where the vertices should lie, up to a shift along the outline [px], [P, 2]."""
    normal: np.ndarray
    """Unit normals of the mask's outline, [P, 2]."""
    weight: np.ndarray
    """At most 1, [P]."""
    displacement: np.ndarray
    """Pose correctives of the vertices at rest when the pairs were made [m], [P, 3]."""


@dataclass(frozen=True)
class SurfacePoints:
    """Places on the surface that pixels of the photo show."""

    vertex: np.ndarray
    """The nearest vertex, [P]."""
    offset: np.ndarray
    """From it along the mean hand's surface at rest to the place [m], [P, 3]."""
    displacement: np.ndarray
    """The same with pose correctives, [P, 3]."""
    xy: np.ndarray
    """The pixel's centre [px], [P, 2]."""
    spread: np.ndarray
    """Scale of the Laplace distribution of the place on the surface [px], [P]."""
    normal: np.ndarray
    """Unit normal in the camera's frame, [P, 3]."""


@dataclass(frozen=True)
class Solution:
    """A fitted state and the robust cost it reached."""

    state: FitState
    cost: float


class Fitter:
    """Fits one hand to the target of one photo; `shape` fixes the shape of a known person."""

    def __init__(self, kinematics: HandKinematics, target: FitTarget, *, settings: FitSettings | None = None,
                 shape: np.ndarray | None = None):  # fmt: skip
        self.kinematics, self.target = kinematics, target
        self.settings = s = settings or FitSettings()
        joint, axis = kinematics.dofs.T
        finger_flexion = (axis == 0) & (joint < 13)
        self.relaxed = np.where(finger_flexion, np.array(s.relaxed)[(joint - 1) % 3], 0.0)
        self.gestures = gesture_prior(kinematics, s.gesture)
        self.contact = FingerContact(kinematics)
        self.finger_of_vertex = finger_of(kinematics.hand.segment.cpu().numpy())
        self.finger_of_angle = finger_of(joint)
        self.low, self.high = kinematics.limits[joint, axis].T
        n_shape = kinematics.shape_basis.shape[2]
        if shape is None:
            self.shape_mean, self.shape_sigma = shape_prior(kinematics.hand)
            principal = np.array([name.startswith("pc") for name in kinematics.hand.shape_names])
            size = np.sqrt((kinematics.shape_basis**2).sum(1).mean(0))
            silent = principal & (size < s.silent_shape)
            self.shape_mean[silent], self.shape_sigma[silent] = 0.0, _FIXED
        else:
            self.shape_mean, self.shape_sigma = np.asarray(shape, np.float64), np.full(n_shape, _FIXED)
        diagonal = np.hypot(*target.size)
        self.focal = target.focal or 0.5 * diagonal / np.tan(s.view_angle / 2)
        self.n_angles = len(kinematics.dofs)
        every = np.arange(6 + self.n_angles + n_shape + (target.focal is None))
        self.everything, self.pose_and_camera = every, every[: 6 + self.n_angles]

    # ---- terms

    def system(
        self, state: FitState, *, landmarks: bool = True, robust: bool = True, pairs: OutlinePairs | None = None,
        surface: SurfacePoints | None = None, gesture: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
        """Weighted residuals, their Jacobian by a step, and the robust cost in the likeliest gesture or a given one."""
        s, box = self.settings, self.target.box
        sigma, bone = (s.landmark, s.bone) if surface is None else (s.weak_landmark, s.weak_bone)
        sigma *= box
        joints = self.kinematics.pose_joints(state.angles, state.shape)
        points = state.linearize(*self.kinematics.landmarks(joints))
        n = points.d_image.shape[2]
        residuals, jacobians, cost = [], [], 0.0
        if landmarks:
            error = (points.image - self.target.xy) / sigma
            weight, loss = charbonnier((error**2).sum(1), s.landmark_scale if robust else 1e6)
            weight = weight**0.5
            residuals.append((error * weight[:, None]).ravel())
            jacobians.append((points.d_image * (weight / sigma)[:, None, None]).reshape(-1, n))
            cost += float(loss.sum())
        for residual, jacobian in (*self._bone_term(points, bone), *self._priors(state, n, gesture)):
            residuals.append(residual)
            jacobians.append(jacobian)
            cost += float(residual @ residual)
        if pairs is not None and len(pairs.vertex):
            rim = state.linearize(*self.kinematics.vertices(joints, pairs.vertex, pairs.displacement))
            error = ((rim.image - pairs.target) * pairs.normal).sum(1) / (s.outline * box)
            weight, loss = cauchy(error**2, s.outline_scale)
            share = s.outline_weight * pairs.weight / max(pairs.weight.sum(), 1e-9)
            weight = np.sqrt(weight * share)
            residuals.append(error * weight)
            jacobians.append(np.einsum("na,nak->nk", pairs.normal * (weight / (s.outline * box))[:, None], rim.d_image))
            cost += float((loss * share).sum())
        if surface is not None:
            contact = self.contact.term(joints, -state.rotation.T @ state.translation())
            residuals.append(contact.residual)
            jacobians.append(np.pad(contact.jacobian, ((0, 0), (6, 1))))
            cost += contact.cost
        if surface is not None and len(surface.vertex):
            for residual, jacobian, loss in self._surface_terms(state, joints, surface):
                residuals.append(residual.ravel())
                jacobians.append(jacobian.reshape(-1, n))
                cost += loss
        return np.concatenate(residuals), np.concatenate(jacobians), cost

    def _bone_term(self, points: Linearized, sigma: float) -> list[tuple[np.ndarray, np.ndarray]]:
        if self.target.directions is None:
            return []
        start, end = BONES.T
        bones = points.seen[end] - points.seen[start]
        direction = unit(bones)
        across = np.eye(3) - direction[:, :, None] * direction[:, None]
        across /= np.linalg.norm(bones, axis=1)[:, None, None] * sigma
        residual = (direction - self.target.directions) / sigma
        return [(residual.ravel(), (across @ (points.d_seen[end] - points.d_seen[start])).reshape(len(BONES) * 3, -1))]

    def _surface_terms(
        self, state: FitState, joints: PosedJoints, surface: SurfacePoints
    ) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Pixels against the projections of their places on the surface, and their normals against those there."""
        s, count = self.settings, len(surface.vertex)
        places = state.linearize(*self.kinematics.vertices(joints, surface.vertex, surface.displacement))
        sigma = self._sigmas(surface)
        error = (places.image - surface.xy) / sigma[:, None]
        weight, loss = cauchy((error**2).sum(1), s.surface_scale)
        share = s.surface_weight / count
        weight = np.sqrt(weight * share)[:, None]
        terms = [(error * weight, places.d_image * (weight / sigma[:, None])[..., None], float(loss.sum() * share))]
        normals, by_angle = self.kinematics.normals(joints, surface.vertex)
        normals = normals @ state.rotation.T
        error = (normals - surface.normal) / s.normal
        weight, loss = cauchy((error**2).sum(1), s.surface_scale)
        share = s.normal_weight / count
        weight = np.sqrt(weight * share)[:, None]
        slope = np.zeros(places.d_seen.shape)
        slope[:, :, :3] = -cross_matrices(normals)
        slope[:, :, 6 : 6 + self.n_angles] = state.rotation @ by_angle
        terms.append((error * weight, slope * (weight / s.normal)[..., None], float(loss.sum() * share)))
        return terms

    def _sigmas(self, surface: SurfacePoints) -> np.ndarray:
        """Of each pixel's place [px], [P]."""
        return np.hypot(self.settings.surface * self.target.box, self.settings.surface_spread * surface.spread)

    def _priors(self, state: FitState, n: int, gesture: int | None) -> list[tuple[np.ndarray, np.ndarray]]:
        s, eye = self.settings, np.eye(n)
        angles = slice(6, 6 + self.n_angles)
        over = np.maximum(state.angles - self.high, 0) + np.minimum(state.angles - self.low, 0)
        unlike, slope = self.gestures.term(state.angles, gesture)
        return [
            (unlike, slope @ eye[angles]),
            (over / s.limit, eye[angles] * (over != 0)[:, None] / s.limit),
            ((state.shape - self.shape_mean) / self.shape_sigma,
             eye[6 + self.n_angles : -1] / self.shape_sigma[:, None]),
            (np.array([np.log(state.focal / self.focal) / s.log_focal]), eye[-1:] / s.log_focal),
        ]  # fmt: skip

    # ---- solver

    def solve(self, state: FitState, steps: int, free: np.ndarray, *, tolerance: float = 1e-5, **terms) -> Solution:
        """Minimise the terms over the columns `free` of a step."""

        def model(state: FitState) -> QuadraticModel:
            residual, jacobian, cost = self.system(state, **terms)
            reduced = jacobian[:, free]
            return QuadraticModel(cost, reduced.T @ reduced, reduced.T @ residual)

        def move(state: FitState, change: np.ndarray) -> FitState:
            step = np.zeros(7 + self.n_angles + len(state.shape))
            step[free] = change
            step[:3] *= min(1.0, _MAX_ROTATION / max(float(np.abs(step[:3]).max()), 1e-9))
            return state.moved(step)

        return Solution(*minimize(state, model, move, _DAMPING, steps, _TRIALS, tolerance))

    # ---- stages

    def fit_landmarks(self) -> Solution:
        """Fit to the landmarks, and to the world points if there are any, from the best of the possible starts."""
        if self.target.directions is not None:
            return self._from_start(self._world_start())
        found = [self._from_start(start) for start in self._starts_without_world()]
        return min(found, key=lambda solution: solution.cost)

    def fit_surface(self, state: FitState, surface: SurfacePoints) -> Solution:
        """Fit to what pixels show of the surface, beside landmarks of little weight; in the gesture that fits best."""
        state = self.solve(state, 8, self.everything, tolerance=1e-3, surface=self._corrected(surface, state)).state
        for _ in range(_SEARCHES):
            corrected = self._corrected(surface, state)
            start = self._fingers_by_pixels(state, corrected)
            other = self.solve(start, 8, self.everything, tolerance=1e-3, surface=corrected)
            if other.cost >= self.system(state, surface=corrected)[2]:
                break
            state = other.state
        terms, nearest = {"surface": self._corrected(surface, state)}, self.gestures.scores(state.angles)
        tried = [
            self.solve(state, _GESTURE_STEPS, self.everything, tolerance=1e-3, gesture=int(k), **terms)
            for k in nearest.argsort(kind="stable")[:_GESTURES]
        ]
        return min(tried, key=lambda solution: solution.cost)

    def _fingers_by_pixels(self, state: FitState, surface: SurfacePoints) -> FitState:
        """`state` with each finger bent as in the gesture in which its own pixels fit best.

        Steps do not lead from a finger that the landmarks have straight to a folded one: robust residuals that are
        large have no slope.
        """
        if not len(surface.vertex):
            return state
        s, means = self.settings, self.gestures.means
        finger, sigma = self.finger_of_vertex[surface.vertex], self._sigmas(surface)[:, None]
        losses = np.zeros((len(means), 6))
        for own, angles in zip(losses, means, strict=True):
            joints = self.kinematics.pose_joints(angles, state.shape)
            places = self.kinematics.places(joints, surface.vertex, surface.displacement)
            error = (state.project(places) - surface.xy) / sigma
            own += np.bincount(finger, cauchy((error**2).sum(1), s.surface_scale)[1], len(own))
        chosen = (losses + _WHOLE * losses.sum(1, keepdims=True)).argmin(0)
        return replace(state, angles=means[chosen[self.finger_of_angle], np.arange(self.n_angles)])

    def refine(
        self, state: FitState, match: Callable[[FitState], OutlinePairs], rounds: int,
        surface: SurfacePoints | None = None,
    ) -> Solution:  # fmt: skip
        """Alternate between pairing outlines and three steps of all unknowns."""
        found = Solution(state, np.inf)
        for _ in range(rounds):
            corrected = None if surface is None else self._corrected(surface, found.state)
            found = self.solve(found.state, 3, self.everything, pairs=match(found.state), surface=corrected)
        return found

    def _corrected(self, surface: SurfacePoints, state: FitState) -> SurfacePoints:
        """`surface` with the pose correctives of `state`."""
        correctives = self.kinematics.correctives(self.kinematics.all_angles(state.angles))
        return replace(surface, displacement=surface.offset + correctives[surface.vertex])

    def _from_start(self, state: FitState) -> Solution:
        state = self.solve(state, 15, self.pose_and_camera, tolerance=1e-3, robust=False).state
        return self.solve(state, 40, self.everything)

    def _rest_state(self) -> FitState:
        centre = np.array(self.target.size) / 2
        return FitState(np.eye(3), np.zeros(3), self.relaxed.copy(), self.shape_mean.copy(), self.focal, centre)

    def _points(self, state: FitState) -> np.ndarray:
        return self.kinematics.landmarks(self.kinematics.pose_joints(state.angles, state.shape))[0]

    def _centred(self, state: FitState, log_depth: float) -> FitState:
        """`state` at a depth, with the mean of its points on the mean of the landmarks."""
        middle = (self._points(state) @ state.rotation.T).mean(0)[:2] / np.exp(log_depth)
        aim = (self.target.xy - state.centre).mean(0) / state.focal - middle
        return replace(state, position=np.array([*aim, log_depth]))

    def _world_start(self) -> FitState:
        """Rotation and angles from the bone directions alone, depth from the scale of the world points."""
        e = self.target
        assert e.directions is not None and e.pixels_per_metre is not None and e.bone_length is not None
        state = self._rest_state()
        points = self._points(state)
        world = np.zeros((21, 3))
        for (start, end), direction in zip(BONES, e.directions, strict=True):
            world[end] = world[start] + direction * np.linalg.norm(points[end] - points[start])
        rotation = rotation_between(points[_PALM], world[_PALM])
        # The bone lengths give the scale, not a rigid fit: a bent hand is smaller than the relaxed one.
        length = np.linalg.norm(points[BONES[:, 1]] - points[BONES[:, 0]], axis=1).sum()
        log_depth = float(np.log(state.focal / (e.pixels_per_metre * e.bone_length / length)))
        state = replace(state, rotation=rotation)
        rotation_and_angles = np.r_[0:3, 6 : 6 + self.n_angles]
        state = self.solve(state, 12, rotation_and_angles, tolerance=1e-3, landmarks=False).state
        return self._centred(state, log_depth)

    def _starts_without_world(self) -> list[FitState]:
        """Starts without world points: palm or back towards the camera, upright or tilted, rotated as the palm lies."""
        state = self._rest_state()
        points, xy = self._points(state), self.target.xy
        starts = []
        for flip in (0.0, np.pi):
            for tilt in (-0.6, 0.0, 0.6):
                # At rest the fingers point to -x and the palm to -y: look at the palm along +y, then tilt about z.
                facing = cv2.Rodrigues(np.array([np.pi / 2 + flip, 0, 0]))[0] @ cv2.Rodrigues(np.array([0, 0, tilt]))[0]
                flat = (points @ facing.T)[:, :2]
                a, b = flat[_PALM] - flat[_PALM].mean(0), xy[_PALM] - xy[_PALM].mean(0)
                angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
                rotation = cv2.Rodrigues(np.array([0, 0, angle]))[0] @ facing
                scale = np.sqrt((b**2).sum() / (a**2).sum())
                starts.append(self._centred(replace(state, rotation=rotation), float(np.log(state.focal / scale))))
        return starts
