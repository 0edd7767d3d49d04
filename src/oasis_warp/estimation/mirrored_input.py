"""The view of a photo that the fit takes: left hands mirrored, large photos reduced, in float64 numpy."""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.mirror import mirror_camera, mirror_landmarks, mirror_pixels, mirror_pose
from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo, Side
from oasis_warp.estimation.fit_state import FitState
from oasis_warp.estimation.fit_target import evidence_of
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.hand.kinematics import HandKinematics

_LARGEST = 800.0
"""Larger hands are fitted in a reduced photo, because the mask is cut from fewer pixels anyway [px]."""


def array(tensor: Tensor) -> np.ndarray:
    """A tensor as float64 numpy, in which the fit computes."""
    return tensor.detach().cpu().numpy().astype(np.float64)


def real(values: np.ndarray) -> Tensor:
    """An array as the float32 tensor that the other stages take."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


class MirroredInput:
    """A photo and one hand in it, mirrored if the hand is a left one, and reduced if it is very large."""

    def __init__(self, photo: Photo, landmarks: Landmarks, focal: float | None):
        self.name, self.mirrored = photo.name, landmarks.side == "left"
        rgb = photo.rgb.cpu().numpy()
        self.photo_size = rgb.shape[1], rgb.shape[0]
        factor = min(1.0, _LARGEST / max(box_size(array(landmarks.xy)), 1.0))
        size = (max(8, round(rgb.shape[1] * factor)), max(8, round(rgb.shape[0] * factor)))
        self.scale = np.array(size) / self.photo_size
        """Pixels of this view per pixel of the photo, in x and y."""
        landmarks = landmarks._replace(
            xy=landmarks.xy.double() * torch.from_numpy(self.scale),
            world=None if landmarks.world is None else landmarks.world.double(),
        )
        if self.mirrored:
            landmarks = mirror_landmarks(landmarks, size[0])
        self.rgb = self._seen(rgb, size)
        self.alpha = None if photo.alpha is None else self._seen(photo.alpha.cpu().numpy(), size)
        known = focal or photo.focal
        world = None if landmarks.world is None else array(landmarks.world)
        self.evidence = evidence_of(array(landmarks.xy), world, size, known and known * float(self.scale[0]))

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

    def pose(self, kinematics: HandKinematics, state: FitState) -> HandPose:
        """The pose in the photo's own frame."""
        parts = kinematics.all_angles(state.angles)[1:], state.turn, state.translation()
        pose = HandPose(*map(torch.from_numpy, parts))
        return HandPose(*(part.float() for part in (mirror_pose(pose) if self.mirrored else pose)))

    def camera(self, state: FitState) -> Camera:
        """The camera of the photo."""
        K = np.array([[state.focal, 0, state.centre[0]], [0, state.focal, state.centre[1]], [0, 0, 1]])
        camera = Camera(torch.eye(4).double(), torch.from_numpy(K), *self.evidence.size)
        K = (mirror_camera(camera) if self.mirrored else camera).K.numpy()
        K[:2] /= self.scale[:, None]
        return Camera(torch.eye(4), real(K), *self.photo_size)


class MirroredFit(NamedTuple):
    """A `HandFit` as a right hand."""

    state: FitState
    angles: np.ndarray
    """All angles, [16, 3]."""
    xy: np.ndarray
    mask: np.ndarray


def mirrored_state(
    kinematics: HandKinematics, side: Side, shape: np.ndarray, pose: HandPose, camera: Camera
) -> FitState:
    """A pose and camera as the unknowns of the fit in the photo, which is mirrored for a left hand."""
    pose = HandPose(*(part.double() for part in pose))
    camera = camera._replace(viewmat=camera.viewmat.double(), K=camera.K.double())
    if side == "left":
        pose, camera = mirror_pose(pose), mirror_camera(camera)
    translation, K = array(pose.translation), array(camera.K)
    place = np.array([*(translation[:2] / translation[2]), np.log(translation[2])])
    angles = array(pose.angles)[kinematics.dofs[:, 0] - 1, kinematics.dofs[:, 1]]
    return FitState(array(pose.orientation), place, angles, shape, float(K[0, 0]), K[:2, 2])


def mirrored_fit(kinematics: HandKinematics, fit: HandFit) -> MirroredFit:
    """A fit in the photo, which is mirrored for a left hand."""
    state = mirrored_state(kinematics, fit.side, array(fit.shape), fit.pose, fit.camera)
    xy, mask = fit.landmarks.xy.double(), fit.mask.detach().cpu()
    if fit.side == "left":
        xy, mask = mirror_pixels(xy, fit.camera.width), mask.flip(1)
    angles = np.concatenate([np.zeros((1, 3)), array(fit.pose.angles)])
    return MirroredFit(state, angles, array(xy), mask.numpy())
