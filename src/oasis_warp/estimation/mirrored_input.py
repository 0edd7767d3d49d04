"""One hand of a photo as a right hand: left ones are mirrored on the way in, and results mirrored back on the way out.

With M = diag(-1, 1, 1), a left hand of pose (R, t) is the mirrored model M v; in the mirrored photo it is a right hand
of pose (M R M, M t), and x becomes width - x.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo, Side
from oasis_warp.estimation.fit_state import FitState
from oasis_warp.estimation.fit_target import Evidence, evidence_of
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.hand.kinematics import HandKinematics

_MIRROR = np.array([-1.0, 1.0, 1.0])
_LARGEST = 800.0
"""Larger hands are fitted in a reduced photo: the mask is cut from fewer pixels anyway [px]."""


def array(tensor: Tensor) -> np.ndarray:
    """A tensor in float64 numpy, the fit's own currency."""
    return tensor.detach().cpu().numpy().astype(np.float64)


def real(values: np.ndarray) -> Tensor:
    """The float32 tensor that other stages speak."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


class MirroredInput:
    """A photo and one hand in it, mirrored if the hand is a left one, and reduced if it is very large."""

    def __init__(self, photo: Photo, landmarks: Landmarks, focal: float | None):
        self.name, self.mirrored = photo.name, landmarks.side == "left"
        rgb, xy = photo.rgb.cpu().numpy(), array(landmarks.xy)
        world = None if landmarks.world is None else array(landmarks.world)
        self.photo_size = rgb.shape[1], rgb.shape[0]
        factor = min(1.0, _LARGEST / max(box_size(xy), 1.0))
        size = (max(8, round(rgb.shape[1] * factor)), max(8, round(rgb.shape[0] * factor)))
        self.scale = np.array(size) / self.photo_size
        """Pixels of this view a pixel of the photo, x and y."""
        xy = xy * self.scale
        if self.mirrored:
            xy = mirror_points(xy, size[0])
            world = None if world is None else world * _MIRROR
        self.rgb = self._seen(rgb, size)
        self.alpha = None if photo.alpha is None else self._seen(photo.alpha.cpu().numpy(), size)
        known = focal or photo.focal
        self.evidence: Evidence = evidence_of(xy, world, size, known and known * float(self.scale[0]))

    def _seen(self, image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """An image [H, W, ...] of the photo in this view."""
        if size != self.photo_size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(image[:, ::-1]) if self.mirrored else image

    def in_photo(self, mask: np.ndarray) -> np.ndarray:
        """A mask [h, w] of this view in the photo."""
        mask = mask[:, ::-1] if self.mirrored else mask
        if mask.shape[::-1] == self.photo_size:
            return mask
        return cv2.resize(np.ascontiguousarray(mask), self.photo_size, interpolation=cv2.INTER_LINEAR)

    def pose(self, rig: HandKinematics, state: FitState) -> HandPose:
        """The pose in the photo's own frame."""
        mirror = _MIRROR if self.mirrored else np.ones(3)
        return HandPose(
            angles=real(rig.all_angles(state.angles)[1:]),
            orientation=real(mirror[:, None] * state.turn * mirror),
            translation=real(mirror * state.translation()),
        )

    def camera(self, state: FitState) -> Camera:
        """The camera of the photo."""
        x, y = state.centre
        x = self.evidence.size[0] - x if self.mirrored else x
        K = np.array([[state.focal, 0, x], [0, state.focal, y], [0, 0, 1]])
        K[:2] /= self.scale[:, None]
        return Camera(torch.eye(4), real(K), *self.photo_size)


def mirror_points(xy: np.ndarray, width: int) -> np.ndarray:
    """Points of a photo in its mirror image [px]."""
    return np.array([width, 0]) + xy * [-1, 1]


class MirroredFit(NamedTuple):
    """A `HandFit` as a right hand."""

    state: FitState
    angles: np.ndarray
    """All angles, [16, 3]."""
    xy: np.ndarray
    mask: np.ndarray


def mirrored_state(rig: HandKinematics, side: Side, shape: np.ndarray, pose: HandPose, camera: Camera) -> FitState:
    """A pose and camera as the fit's state in the photo, which is mirrored for a left hand."""
    turn, translation, K = array(pose.orientation), array(pose.translation), array(camera.K)
    centre = K[:2, 2]
    if side == "left":
        turn, translation = _MIRROR[:, None] * turn * _MIRROR, translation * _MIRROR
        centre = mirror_points(centre, camera.width)
    place = np.array([*(translation[:2] / translation[2]), np.log(translation[2])])
    angles = array(pose.angles)[rig.dofs[:, 0] - 1, rig.dofs[:, 1]]
    return FitState(turn, place, angles, shape, float(K[0, 0]), centre)


def mirrored_fit(rig: HandKinematics, fit: HandFit) -> MirroredFit:
    """A fit in the photo, which is mirrored for a left hand."""
    state = mirrored_state(rig, fit.side, array(fit.shape), fit.pose, fit.camera)
    xy, mask = array(fit.landmarks.xy), fit.mask.detach().cpu().numpy()
    if fit.side == "left":
        xy, mask = mirror_points(xy, fit.camera.width), np.ascontiguousarray(mask[:, ::-1])
    return MirroredFit(state, np.concatenate([np.zeros((1, 3)), array(fit.pose.angles)]), xy, mask)
