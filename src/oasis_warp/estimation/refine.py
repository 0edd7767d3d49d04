"""Joint refinement: the pose in which a prior's guess, lit as the photo is, looks most like the photo.

The estimator's landmarks are off by some per cent of the hand, so colours of the photo land on the wrong skin. The fit
uses only landmarks and outlines. Once a prior has guessed the hand's appearance, the inside of the outline helps too:
shading, nails, knuckles, and borders between fingers. Damped robust least squares over the rotation, position and 26
angles of the fit minimises, from coarse to fine,

- the band-passed difference of photo and image, inside mask and surface (`shaded_hand.detail_gap`),
- the difference of the blurred outline and the blurred mask, above the wrist,
- the priors of the fit, the distances from its landmarks, and the distance from the start.

Jacobians of the images are finite differences. A depth buffer of a small image takes a millisecond per pose, and
differences account for occlusion. The shape and the focal length stay fixed: a photo does not tell the focal length
from the distance.
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
from oasis_warp.estimation.fit_problem import FitState, FitTarget, array, real
from oasis_warp.estimation.landmarks import BONES
from oasis_warp.estimation.least_squares import Damping, QuadraticModel, cauchy, minimize
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.shaded_hand import (
    CERTAIN,
    RenderedSurface,
    blur,
    detail_gap,
    outline_gap,
    render_surface,
    shading_scene,
    solve_light,
)
from oasis_warp.estimation.surface_state import shape_of, state_of_surface
from oasis_warp.hand.kinematics import HandKinematics, unit
from oasis_warp.hand.skinning import rest_hand, skin, skin_surface

SIZE = 96
"""Side of the image that is compared [px]. Errors are several of its pixels, so finer images find no more."""
LEVELS = ((3.0, 12.0), (1.5, 6.0))
"""Pairs of blurs whose difference is compared, from coarse to fine [px of `SIZE`]."""
OUTLINE_BLUR = 1.5
ITERATIONS, TRIALS = 5, 4
"""Largest numbers of steps per level, and of dampings per step."""
PHOTO_WEIGHT, OUTLINE_WEIGHT = 400.0, 150.0
"""Numbers of observations that all pixels together, and all of the outline, count as."""
PHOTO_SIGMA = (0.006, 0.05)
"""Bounds of sigma of the photo's residuals, which is estimated at the start [sRGB]."""
PHOTO_SCALE, OUTLINE_SCALE = 2.0, 2.0
"""Robust scales in sigmas (Cauchy)."""
OUTLINE_SIGMA = 0.15
OUTLINE_PIXELS = 4.5
"""Width of a blurred outline [px of `SIZE`]."""
DETECTED, FIT_WEIGHT = FitSettings(), 1.0
"""Settings and weight of the fit's own terms with detected landmarks."""
UNDETECTED, ANCHOR_WEIGHT = FitSettings(landmark=0.03), 0.25
"""The same with the model's landmarks at the start instead, which only hold the hand in place."""
WRIST = 0.15
"""Height above the wrist from which outlines count, as a fraction of the way to the knuckles."""
ROTATION_SIGMA, ACROSS_SIGMA, AWAY_SIGMA = 0.5, 0.1, 0.2
"""Errors of the start: rotation [rad], x / z and y / z, log z."""
ANGLE_SIGMA = (0.6, 0.3, 0.2)
"""Errors of the start's flexion, abduction and twist [rad]."""
STEPS = (0.02, 0.004, 0.02, 0.03)
"""Steps of the finite differences: rotation, x / z and y / z, log z, angles."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
DAMPING = Damping(start=1e-2, grow=5, shrink=4, least=1e-4)
LONGEST = 0.3
"""Largest change of an unknown in one step."""
TOLERANCE = 1e-3
MIN_OVERLAP = 0.5
"""Intersection over union of surface and mask at the start below which nothing is refined."""
MIN_PIXELS = 60
"""Number of compared pixels below which nothing is refined."""
MIN_GAIN = 0.02
"""Fraction by which the photo's residual must fall for the result to be accepted."""
MASK_SLACK = 0.05
"""Intersection over union with the mask that may be lost for it; masks themselves are off by as much."""


class PhotoError(NamedTuple):
    """How far the photo is from a rendering in a pose."""

    gap: float
    """Robust mean of the squared residuals of the photo, in sigmas of the start."""
    mask_iou: float
    """Intersection over union of surface and mask, above the wrist."""
    pixels: int
    """Number of pixels that were compared."""


class Refinement(NamedTuple):
    """The refined pose, or the start where nothing better was found."""

    pose: HandPose
    """In the frame of the crop's camera; on the CPU, as fits are."""
    crop: HandCrop
    """With the surface in that pose."""
    accepted: bool
    before: PhotoError
    after: PhotoError
    moved: float
    """Median displacement of the vertices in the image [px of the crop]."""
    turned: float
    """Rotation of the whole hand [rad]."""
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
        guess: The prior's output for `crop`, with the colours of even light.
        crop: With an identity viewmat; joints and tips are not used.
        landmarks: Detected landmarks [px of the crop]; by default those of the model at the start.
        size: Size for `avatar.anchors.inset_offsets`, by which the surface of `crop` lies below the skin.
    """
    problem = _Problem(hand, guess, crop, landmarks, size)
    start = problem.start
    before = problem.photo_error(start)
    found, after = start, before
    if before.pixels >= MIN_PIXELS and before.mask_iou >= MIN_OVERLAP:
        found = problem.solve()
        after = problem.photo_error(found)
    accepted = after.gap < (1 - MIN_GAIN) * before.gap and after.mask_iou > before.mask_iou - MASK_SLACK
    if not accepted:
        found, after = start, before
    posed = problem.posed_hand(found) if accepted else crop.posed
    pixels = [project(crop.camera, vertices)[0] for vertices in (crop.posed.vertices, posed.vertices)]
    change = problem.change(found)
    return Refinement(
        pose=HandPose(*(part[0].cpu() for part in problem.poses([found]))),
        crop=crop._replace(posed=posed),
        accepted=accepted,
        before=before,
        after=after,
        moved=float((pixels[1] - pixels[0]).norm(dim=1).median()),
        turned=float(np.linalg.norm(change[:3])),
        bent=float(np.median(np.abs(change[6:]))),
    )


class _Problem:
    """The cost of explaining one photo by a state of the fit."""

    def __init__(
        self, hand: HandModel, guess: CanonicalGaussians, crop: HandCrop, landmarks: Tensor | None, size: int
    ):
        self.kinematics, camera = HandKinematics(hand), crop.camera
        device = crop.image.device
        self.hand = hand.to(device)
        K, carrier, inset = array(camera.K), array(crop.rest.vertices), array(inset_offsets(hand, size))
        shape = shape_of(self.kinematics, carrier - inset)
        self.start, detail = state_of_surface(
            self.kinematics, shape, carrier, array(crop.posed.vertices), float(K[0, 0]), K[:2, 2]
        )
        self.n_unknowns = 6 + len(self.start.angles)
        bare = rest_hand(self.hand, real(shape).to(device))
        self.carrier = bare._replace(vertices=bare.vertices + real(detail).to(device))
        self.skin = bare._replace(vertices=bare.vertices + real(detail - inset).to(device))
        extent = (camera.width, camera.height)
        self.fitter = _anchor(self.kinematics, self.start, extent, landmarks)
        self.fit_weight = ANCHOR_WEIGHT if landmarks is None else FIT_WEIGHT
        above = torch.from_numpy(wrist_line(self.fitter.target.xy).above_mask(extent, WRIST)).to(crop.mask)
        self.scene = shading_scene(self.hand, guess, crop, above * crop.above_wrist, SIZE)
        area = float((self.scene.mask * self.scene.compared).sum().clamp_min(1))
        self.outline_pixels = OUTLINE_PIXELS * 4 * area**0.5
        self.sigmas = {blurs: self._photo_sigma(blurs) for blurs in LEVELS}
        axis = self.kinematics.dofs[:, 1]
        angle_sigma = np.array(ANGLE_SIGMA)[axis]
        self.sigma = np.r_[np.full(3, ROTATION_SIGMA), np.full(2, ACROSS_SIGMA), AWAY_SIGMA, angle_sigma]
        rotation, across, away, angle = STEPS
        self.steps = np.r_[np.full(3, rotation), np.full(2, across), away, np.full(len(axis), angle)]

    # ---- states

    def moved(self, state: FitState, step: np.ndarray) -> FitState:
        """The state after a step of the unknowns; shape and focal length stay."""
        return state.moved(np.r_[step, np.zeros(len(state.shape) + 1)])

    def change(self, state: FitState) -> np.ndarray:
        """Step of the unknowns from the start to `state`."""
        start, rotation = self.start, cv2.Rodrigues(state.rotation @ self.start.rotation.T)[0][:, 0]
        return np.r_[rotation, state.position - start.position, state.angles - start.angles]

    def poses(self, states: list[FitState]) -> HandPose:
        """The poses of B states, on the photo's device, with a batch axis."""
        angles = [self.kinematics.all_angles(state.angles)[1:] for state in states]
        parts = angles, [state.rotation for state in states], [state.translation() for state in states]
        return HandPose(*(real(np.stack(part)).to(self.scene.image.device) for part in parts))

    def posed_hand(self, state: FitState) -> PosedHand:
        """The surface that carries Gaussians, in one state."""
        return skin(self.hand, self.carrier, HandPose(*(part[0] for part in self.poses([state]))))

    def rendered(self, states: list[FitState]) -> RenderedSurface:
        """The skin in some states."""
        return render_surface(self.scene, skin_surface(self.hand, self.skin, self.poses(states)))

    # ---- terms

    def _photo_sigma(self, blurs: tuple[float, float]) -> float:
        """Sigma of the photo's residuals: that at the start."""
        rendered = self.rendered([self.start])
        gap = detail_gap(self.scene, rendered, solve_light(self.scene, rendered, 0), *blurs)[0]
        gap = gap[:, self._inside(rendered, blurs[0])].abs().cpu().numpy()
        low, high = PHOTO_SIGMA
        return float(np.clip(MAD_TO_SIGMA * np.median(gap), low, high)) if gap.size else high

    def _inside(self, rendered: RenderedSurface, width: float) -> Tensor:
        """Pixels that are compared, from the first of the rendered states, [S, S]."""
        both = self.scene.mask * self.scene.compared * rendered.covered[0]
        return blur(both[None, None], width)[0, 0] > CERTAIN

    def _gaps(
        self, rendered: RenderedSurface, light: Tensor, blurs: tuple[float, float]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals of photo [B, 3, S, S] and outline [B, S, S] in sigmas, and the weights of the photo's pixels."""
        inside = self._inside(rendered, blurs[0]).to(rendered.covered)
        photo = detail_gap(self.scene, rendered, light, *blurs) / self.sigmas[blurs]
        outline = outline_gap(self.scene, rendered, OUTLINE_BLUR) / OUTLINE_SIGMA
        return photo, outline, inside * (PHOTO_WEIGHT / inside.sum().clamp_min(1))

    def _image_cost(self, photo: Tensor, outline: Tensor, share: Tensor) -> float:
        """Robust cost of one state's residuals."""
        of_outline = cauchy(outline**2, OUTLINE_SCALE)[1].sum() * (OUTLINE_WEIGHT / self.outline_pixels)
        return float((cauchy((photo**2).sum(0), PHOTO_SCALE)[1] * share).sum() + of_outline)

    def cost(self, state: FitState, light: Tensor, blurs: tuple[float, float]) -> float:
        """The cost that is minimised, in a given light."""
        photo, outline, share = self._gaps(self.rendered([state]), light, blurs)
        of_fit = self.fitter.system(state)[2]
        from_start = float(((self.change(state) / self.sigma) ** 2).sum())
        return self._image_cost(photo[0], outline[0], share) + self.fit_weight * of_fit + from_start

    def linearize(self, state: FitState, blurs: tuple[float, float]) -> tuple[QuadraticModel, Tensor]:
        """The cost near `state` in the light that suits `state` best, and that light."""
        rendered = self.rendered([state, *(self.moved(state, step) for step in np.diag(self.steps))])
        light = solve_light(self.scene, rendered, 0)
        photo, outline, share = self._gaps(rendered, light, blurs)
        weight = cauchy((photo[0] ** 2).sum(0), PHOTO_SCALE)[0] * share
        outline_weight = cauchy(outline[0] ** 2, OUTLINE_SCALE)[0] * (OUTLINE_WEIGHT / self.outline_pixels)
        weight = torch.cat([weight.expand_as(photo[0]).flatten(), outline_weight.flatten()]).sqrt()
        gaps = torch.cat([photo.flatten(1), outline.flatten(1)], 1) * weight
        slope = (gaps[1:] - gaps[0]) / torch.from_numpy(self.steps).to(gaps)[:, None]
        products = array(torch.cat([slope @ slope.T, (slope @ gaps[0])[:, None]], 1))
        residual, jacobian, of_fit = self.fitter.system(state)
        jacobian, change = jacobian[:, : self.n_unknowns], self.change(state)
        from_start = float(((change / self.sigma) ** 2).sum())
        return QuadraticModel(
            self._image_cost(photo[0], outline[0], share) + self.fit_weight * of_fit + from_start,
            products[:, :-1] + self.fit_weight * jacobian.T @ jacobian + np.diag(self.sigma**-2.0),
            products[:, -1] + self.fit_weight * jacobian.T @ residual + change / self.sigma**2,
        ), light

    # ---- solver

    def solve(self) -> FitState:
        """The state of least cost, level by level."""
        state = self.start
        for blurs in LEVELS:
            state = self._solve_level(state, blurs)
        return state

    def _solve_level(self, start: FitState, blurs: tuple[float, float]) -> FitState:
        light = None

        def model(state: FitState) -> QuadraticModel:
            nonlocal light
            quadratic, light = self.linearize(state, blurs)
            return quadratic

        def move(state: FitState, step: np.ndarray) -> FitState:
            return self.moved(state, step * min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-9)))

        def cost(state: FitState) -> float:
            assert light is not None
            return self.cost(state, light, blurs)

        return minimize(start, model, move, DAMPING, ITERATIONS, TRIALS, TOLERANCE, cost)[0]

    def photo_error(self, state: FitState) -> PhotoError:
        """How well a state explains the photo at the finest level, in the light that suits it best."""
        rendered = self.rendered([state])
        photo, _, share = self._gaps(rendered, solve_light(self.scene, rendered, 0), LEVELS[-1])
        loss = cauchy((photo[0] ** 2).sum(0), PHOTO_SCALE)[1] * share
        compared = self.scene.compared > CERTAIN
        surface, mask = (rendered.covered[0] > CERTAIN) & compared, (self.scene.mask > CERTAIN) & compared
        overlap = float((surface & mask).sum() / (surface | mask).sum().clamp_min(1))
        return PhotoError(float(loss.sum()) / PHOTO_WEIGHT, overlap, int((share > 0).sum()))


def _anchor(
    kinematics: HandKinematics, start: FitState, size: tuple[int, int], landmarks: Tensor | None
) -> Fitter:
    """The fit's terms, with bones at the start and, where none were detected, the landmarks at the start."""
    points = kinematics.landmarks(kinematics.pose_joints(start.angles, start.shape))[0]
    xy, seen = start.project(points) if landmarks is None else array(landmarks), start.in_camera(points)
    bones = unit(seen[BONES[:, 1]] - seen[BONES[:, 0]])
    settings = UNDETECTED if landmarks is None else DETECTED
    return Fitter(
        kinematics, FitTarget(xy, bones, None, None, size, start.focal), settings=settings, shape=start.shape
    )
