"""Joint refinement: the pose in which a prior's guess, lit as the photo is, looks most like the photo.

The estimator's landmarks are some per cent of the hand off, and the colours of the photo then land on the wrong skin.
Its fit knows landmarks and outlines only; once a prior has said how the hand looks, the inside of the outline speaks
too: shading, nails, knuckles, the borders between fingers. Damped robust least squares (Levenberg-Marquardt) over turn,
place and the 26 angles of the fit, from coarse to fine, of

- photo less picture, band-passed, inside mask and surface (`shaded_hand.detail_gap`),
- the blurred outline less the blurred mask, above the wrist,
- what holds the pose: the priors of the fit, its landmarks, and where it started.

Derivatives of the pictures are differences: a depth buffer of a small picture costs a millisecond a pose, and
differences see what hides what. The shape stays, and the focal length, which one photo tells from the distance least of
all.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import PRIOR_SIZE, inset_offsets
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandPose, PosedHand
from oasis_warp.estimation.fit import FitSettings, Fitter
from oasis_warp.estimation.fit_state import FitState
from oasis_warp.estimation.fit_target import Evidence as FitTarget
from oasis_warp.estimation.landmarks import BONES
from oasis_warp.estimation.mirrored_input import array, real
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.shaded_hand import (
    CERTAIN,
    Drawn,
    blur,
    detail_gap,
    draw,
    make_scene,
    outline_gap,
    solve_light,
)
from oasis_warp.estimation.surface_state import shape_of, state_of_surface
from oasis_warp.hand.kinematics import HandKinematics, unit
from oasis_warp.hand.skinning import rest_hand, skin, skin_surface

SIZE = 96
"""Side of the picture that is compared [px]: finer ones find no more, as errors are several of its pixels."""
LEVELS = ((3.0, 12.0), (1.5, 6.0))
"""Blurs between which pictures are compared, from coarse to fine [px of `SIZE`]."""
OUTLINE_BLUR = 1.5
ITERATIONS = 5
"""At each level, at most."""
TRIES = 4
PHOTO_WEIGHT, OUTLINE_WEIGHT = 400.0, 150.0
"""All pixels together, and all of the outline, count as so many observations."""
PHOTO_SIGMA = (0.006, 0.05)
"""Bounds of the expected gap, which is taken from the start's own [sRGB]."""
PHOTO_SCALE, OUTLINE_SCALE = 2.0, 2.0
"""Robust scales in sigmas (Cauchy)."""
OUTLINE_SIGMA = 0.15
OUTLINE_PIXELS = 4.5
"""Width of a blurred outline [px of `SIZE`]."""
DETECTED, FIT_WEIGHT = FitSettings(), 1.0
"""The fit's own terms where there are landmarks."""
UNKNOWN, ANCHOR_WEIGHT = FitSettings(landmark=0.03), 0.25
"""The same where those of the start stand in for them, which only hold the hand where it is."""
WRIST = 0.15
"""Outlines count from so far above the wrist, in shares of the way to the knuckles."""
TURN, ACROSS, AWAY = 0.5, 0.1, 0.2
"""How far the start may be off: turn [rad], place as a share of the distance, logarithm of the distance."""
ANGLES = (0.6, 0.3, 0.2)
"""The same for flexion, abduction and twist [rad]."""
STEPS = (0.02, 0.004, 0.02, 0.03)
"""Of the differences: turn, place across and along the view, angles."""
TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median deviation."""
DAMPING = 1e-2
LONGEST = 0.3
"""No unknown changes by more in one iteration."""
TOLERANCE = 1e-3
LEAST_OVERLAP = 0.5
"""Of surface and mask at the start: less, and the mask shows something else."""
LEAST_PIXELS = 60
"""Of hand in the picture that is compared; fewer say nothing."""
LEAST_GAIN = 0.02
"""Share by which the photo must be explained better, or else the start is kept."""
MASK_SLACK = 0.05
"""Overlap with the mask that may be lost for it: masks are this wrong anyway."""


class Explanation(NamedTuple):
    """How well a pose explains the photo."""

    gap: float
    """Robust mean of photo less picture, in sigmas of the start, squared."""
    mask_iou: float
    """Of surface and mask, above the wrist."""
    pixels: int
    """Of the reduced photo that were compared."""


class Refinement(NamedTuple):
    """The refined pose, or the start where nothing better was found."""

    pose: HandPose
    """In the frame of the crop's camera; on the CPU, as fits are."""
    crop: HandCrop
    """With the surface in that pose."""
    accepted: bool
    before: Explanation
    after: Explanation
    moved: float
    """Median over the vertices, in the picture [px of the crop]."""
    turned: float
    """Of the whole hand [rad]."""
    bent: float
    """Median change of a joint's angle [rad]."""


def refine(
    hand: HandModel,
    guess: CanonicalGaussians,
    crop: HandCrop,
    landmarks: Float[Tensor, "21 2"] | None = None,
    size: int = PRIOR_SIZE,
) -> Refinement:
    """Move the posed surface of `crop` to where the colours of `guess` explain the photo best.

    Args:
        hand: On the CPU, as in `reconstruction.reconstruct`.
        guess: What a prior makes of `crop`; its colours should be those of even light.
        crop: Camera with an identity viewmat; joints and tips are not asked for.
        landmarks: What was detected [px of the crop]; the model's own at the start when not given.
        size: As of `avatar.anchors.inset_offsets`, by which the surface of `crop` lies below the skin.
    """
    problem = _Problem(hand, guess, crop, landmarks, size)
    start = problem.start
    before = problem.explain(start)
    found, after = start, before
    if before.pixels >= LEAST_PIXELS and before.mask_iou >= LEAST_OVERLAP:
        found = problem.solve()
        after = problem.explain(found)
    accepted = after.gap < (1 - LEAST_GAIN) * before.gap and after.mask_iou > before.mask_iou - MASK_SLACK
    if not accepted:
        found, after = start, before
    posed = problem.posed_hand(found) if accepted else crop.posed
    places = [project(crop.camera, vertices)[0] for vertices in (crop.posed.vertices, posed.vertices)]
    change = problem.change(found)
    return Refinement(
        pose=HandPose(*(part.cpu() for part in problem.pose([found], batch=False))),
        crop=crop._replace(posed=posed),
        accepted=accepted,
        before=before,
        after=after,
        moved=float((places[1] - places[0]).norm(dim=1).median()),
        turned=float(np.linalg.norm(change[:3])),
        bent=float(np.median(np.abs(change[6:]))),
    )


class _Linear(NamedTuple):
    """Sum of squares about a state, by the unknowns."""

    cost: float
    normal: np.ndarray
    gradient: np.ndarray
    light: Tensor


class _Problem:
    """One photo, and what it costs to explain it by a state."""

    def __init__(
        self, hand: HandModel, guess: CanonicalGaussians, crop: HandCrop, landmarks: Tensor | None, picture: int
    ):
        self.rig, camera = HandKinematics(hand), crop.camera
        device = crop.image.device
        self.hand = hand.to(device)
        K, carrier, sunk = array(camera.K), array(crop.rest.vertices), array(inset_offsets(hand, picture))
        shape = shape_of(self.rig, carrier - sunk)
        self.start, detail = state_of_surface(
            self.rig, shape, carrier, array(crop.posed.vertices), float(K[0, 0]), K[:2, 2]
        )
        self.n = 6 + len(self.start.angles)
        bare = rest_hand(self.hand, real(shape).to(device))
        self.carrier = bare._replace(vertices=bare.vertices + real(detail).to(device))
        self.skin = bare._replace(vertices=bare.vertices + real(detail - sunk).to(device))
        size = (camera.width, camera.height)
        self.fitter = _anchor(self.rig, self.start, size, landmarks)
        self.fit_weight = ANCHOR_WEIGHT if landmarks is None else FIT_WEIGHT
        above = wrist_line(self.fitter.evidence.xy).above_mask(size, WRIST)
        judged = torch.from_numpy(above).to(crop.mask) * crop.above_wrist
        self.scene = make_scene(self.hand, guess, crop, judged, SIZE)
        area = float((self.scene.mask * self.scene.judged).sum().clamp_min(1))
        self.outline_pixels = OUTLINE_PIXELS * 4 * area**0.5
        self.sigmas = {blurs: self._photo_sigma(blurs) for blurs in LEVELS}
        axis = self.rig.dofs[:, 1]
        self.reach = np.r_[np.full(3, TURN), np.full(2, ACROSS), AWAY, np.array(ANGLES)[axis]]
        turn, across, away, angle = STEPS
        self.steps = np.r_[np.full(3, turn), np.full(2, across), away, np.full(len(axis), angle)]

    # ---- states

    def moved(self, state: FitState, step: np.ndarray) -> FitState:
        """The state after a step of the unknowns; shape and focal length stay."""
        return state.moved(np.r_[step, np.zeros(len(state.shape) + 1)])

    def change(self, state: FitState) -> np.ndarray:
        """From the start to `state`, by the unknowns."""
        start, turn = self.start, cv2.Rodrigues(state.turn @ self.start.turn.T)[0][:, 0]
        return np.r_[turn, state.place - start.place, state.angles - start.angles]

    def pose(self, states: list[FitState], *, batch: bool = True) -> HandPose:
        """The poses of some states, on the device of the photo; without the batch's axis that of the only one."""
        angles = [self.rig.all_angles(state.angles)[1:] for state in states]
        parts = angles, [state.turn for state in states], [state.translation() for state in states]
        device = self.scene.image.device
        tensors = (real(np.stack(part)).to(device) for part in parts)
        return HandPose(*(tensor if batch else tensor[0] for tensor in tensors))

    def posed_hand(self, state: FitState) -> PosedHand:
        """The surface that carries Gaussians, in one state."""
        return skin(self.hand, self.carrier, self.pose([state], batch=False))

    def drawn(self, states: list[FitState]) -> Drawn:
        """The skin in some states."""
        return draw(self.scene, skin_surface(self.hand, self.skin, self.pose(states)))

    # ---- terms

    def _photo_sigma(self, blurs: tuple[float, float]) -> float:
        """Gap between photo and picture that is to be expected: that of the start."""
        drawn = self.drawn([self.start])
        gap = detail_gap(self.scene, drawn, solve_light(self.scene, drawn, 0), *blurs)[0]
        gap = gap[:, self._inside(drawn, blurs[0])].abs().cpu().numpy()
        low, high = PHOTO_SIGMA
        return float(np.clip(TO_SIGMA * np.median(gap), low, high)) if gap.size else high

    def _inside(self, drawn: Drawn, width: float) -> Tensor:
        """Pixels that are compared, by the first of the drawn states, [S, S]."""
        both = self.scene.mask * self.scene.judged * drawn.covered[0]
        return blur(both[None, None], width)[0, 0] > CERTAIN

    def _gaps(self, drawn: Drawn, light: Tensor, blurs: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
        """Gaps of photo [B, 3, S, S] and outline [B, S, S] in sigmas, and the share of each pixel of the photo."""
        inside = self._inside(drawn, blurs[0]).to(drawn.covered)
        photo = detail_gap(self.scene, drawn, light, *blurs) / self.sigmas[blurs]
        outline = outline_gap(self.scene, drawn, OUTLINE_BLUR) / OUTLINE_SIGMA
        return photo, outline, inside * (PHOTO_WEIGHT / inside.sum().clamp_min(1))

    def _picture_cost(self, photo: Tensor, outline: Tensor, share: Tensor) -> float:
        """Robust cost of one state's gaps."""
        of_outline = _cauchy(outline**2, OUTLINE_SCALE)[1].sum() * (OUTLINE_WEIGHT / self.outline_pixels)
        return float((_cauchy((photo**2).sum(0), PHOTO_SCALE)[1] * share).sum() + of_outline)

    def cost(self, state: FitState, light: Tensor, blurs: tuple[float, float]) -> float:
        """What is minimised."""
        photo, outline, share = self._gaps(self.drawn([state]), light, blurs)
        of_fit = self.fitter.system(state)[2]
        held = float(((self.change(state) / self.reach) ** 2).sum())
        return self._picture_cost(photo[0], outline[0], share) + self.fit_weight * of_fit + held

    def linearize(self, state: FitState, blurs: tuple[float, float]) -> _Linear:
        """Cost, normal matrix and gradient, in the light that suits `state` best."""
        states = [state, *(self.moved(state, step) for step in np.diag(self.steps))]
        drawn = self.drawn(states)
        light = solve_light(self.scene, drawn, 0)
        photo, outline, share = self._gaps(drawn, light, blurs)
        weight = _cauchy((photo[0] ** 2).sum(0), PHOTO_SCALE)[0] * share
        across = _cauchy(outline[0] ** 2, OUTLINE_SCALE)[0] * (OUTLINE_WEIGHT / self.outline_pixels)
        weight = torch.cat([weight.expand_as(photo[0]).flatten(), across.flatten()]).sqrt()
        gaps = torch.cat([photo.flatten(1), outline.flatten(1)], 1) * weight
        steps = torch.from_numpy(self.steps).to(gaps)
        slope = (gaps[1:] - gaps[0]) / steps[:, None]
        both = array(torch.cat([slope @ slope.T, (slope @ gaps[0])[:, None]], 1))
        residual, jacobian, of_fit = self.fitter.system(state)
        jacobian, change = jacobian[:, : self.n], self.change(state)
        held = float(((change / self.reach) ** 2).sum())
        return _Linear(
            self._picture_cost(photo[0], outline[0], share) + self.fit_weight * of_fit + held,
            both[:, :-1] + self.fit_weight * jacobian.T @ jacobian + np.diag(self.reach**-2.0),
            both[:, -1] + self.fit_weight * jacobian.T @ residual + change / self.reach**2,
            light,
        )

    # ---- solver

    def solve(self) -> FitState:
        """Levenberg-Marquardt, level by level; a step counts only if the robust cost falls."""
        state = self.start
        for blurs in LEVELS:
            damping = DAMPING
            for _ in range(ITERATIONS):
                at = self.linearize(state, blurs)
                for _ in range(TRIES):
                    damped = at.normal + damping * np.diag(np.diag(at.normal))
                    step = -np.linalg.solve(damped, at.gradient)
                    step *= min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-9))
                    trial = self.moved(state, step)
                    cost = self.cost(trial, at.light, blurs)
                    if cost < at.cost:
                        break
                    damping *= 5
                else:
                    break
                state, damping = trial, max(damping / 4, 1e-4)
                if at.cost - cost < TOLERANCE * at.cost:
                    break
        return state

    def explain(self, state: FitState) -> Explanation:
        """How well a state explains the photo, in the light that suits it best, at the finest level."""
        drawn = self.drawn([state])
        photo, _, share = self._gaps(drawn, solve_light(self.scene, drawn, 0), LEVELS[-1])
        loss = _cauchy((photo[0] ** 2).sum(0), PHOTO_SCALE)[1] * share
        judged = self.scene.judged > CERTAIN
        surface, mask = (drawn.covered[0] > CERTAIN) & judged, (self.scene.mask > CERTAIN) & judged
        overlap = float((surface & mask).sum() / (surface | mask).sum().clamp_min(1))
        return Explanation(float(loss.sum()) / PHOTO_WEIGHT, overlap, int((share > 0).sum()))


def _anchor(rig: HandKinematics, start: FitState, size: tuple[int, int], landmarks: Tensor | None) -> Fitter:
    """The fit's terms, with its own landmarks and bones at the start for what was not detected."""
    points = rig.landmarks(rig.chain(start.angles, start.shape), start.shape)[0]
    xy, seen = start.project(points) if landmarks is None else array(landmarks), start.in_camera(points)
    bones = unit(seen[BONES[:, 1]] - seen[BONES[:, 0]])
    settings = UNKNOWN if landmarks is None else DETECTED
    return Fitter(rig, FitTarget(xy, bones, None, None, size, start.focal), settings=settings, shape=start.shape)


def _cauchy(squared: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Weights of the squares in the normal matrix, and the robust loss, of squared gaps in sigmas."""
    share = squared / scale**2
    return 1 / (1 + share), scale**2 * torch.log1p(share)
