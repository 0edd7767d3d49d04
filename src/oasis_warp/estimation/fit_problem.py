"""The data and the unknowns of the fit, in float64 numpy.

`FitTarget` holds what a photo says about one hand. `FitState` holds the unknowns, a right hand in front of a pinhole
camera. `MirroredInput` turns a photo and its landmarks into a target, and a state into the photo's pose and camera.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.mirror import mirror_camera, mirror_landmarks, mirror_pixels, mirror_pose
from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo, Side
from oasis_warp.estimation.landmarks import BONES, box_size
from oasis_warp.hand.kinematics import HandKinematics, unit

_LARGEST = 800.0
"""Larger hands are fitted in a reduced photo, because the mask is cut from fewer pixels anyway [px]."""


def array(tensor: Tensor) -> np.ndarray:
    """A tensor as a float64 array: the fit computes in float64."""
    return tensor.detach().cpu().numpy().astype(np.float64)


def real(values: np.ndarray) -> Tensor:
    """An array as the float32 tensor that the other stages take."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


@dataclass(frozen=True)
class FitTarget:
    """What a photo says about one hand, as a right hand."""

    xy: np.ndarray
    """Landmarks, [21, 2] px."""
    directions: np.ndarray | None
    """Unit directions of the 20 bones in the camera's frame, from the world points."""
    pixels_per_metre: float | None
    """Scale of the world points in the image."""
    bone_length: float | None
    """Sum of the world bones' lengths [m]."""
    size: tuple[int, int]
    """Width and height of the photo."""
    focal: float | None
    """Focal length [px], if known."""

    @property
    def box(self) -> float:
        """Longer side of the landmarks' box [px]."""
        return box_size(self.xy)


def fit_target(
    xy: np.ndarray, world: np.ndarray | None, size: tuple[int, int], focal: float | None = None
) -> FitTarget:
    """The target of landmarks [px] and world points [m] of a right hand in a photo of `size` (width, height)."""
    if world is None:
        return FitTarget(xy, None, None, None, size, focal)
    bones = world[BONES[:, 1]] - world[BONES[:, 0]]
    length = float(np.linalg.norm(bones, axis=1).sum())
    return FitTarget(xy, unit(bones), pixels_per_metre(xy, world), length, size, focal)


def pixels_per_metre(xy: np.ndarray, world: np.ndarray) -> float:
    """Scale of the world points in the image; foreshortening does not change it."""
    flat, seen = world[:, :2] - world[:, :2].mean(0), xy - xy.mean(0)
    return float(np.sqrt((seen**2).sum() / max((flat**2).sum(), 1e-12)))


@dataclass(frozen=True)
class FitState:
    """Unknowns of the fit. A step is (rotation 3, position 3, angles 26, shape S, log focal 1)."""

    rotation: np.ndarray
    """Hand to camera, [3, 3]. The rotation of a step is multiplied from the left."""
    position: np.ndarray
    """(x / z, y / z, log z) of the wrist in the camera's frame."""
    angles: np.ndarray
    shape: np.ndarray
    focal: float
    """[px]."""
    centre: np.ndarray
    """Principal point [px], fixed."""

    def translation(self) -> np.ndarray:
        """The wrist in the camera's frame [m]."""
        return np.exp(self.position[2]) * np.array([self.position[0], self.position[1], 1.0])

    def pixels_per_metre(self) -> float:
        """Scale of the image at the wrist."""
        return self.focal / float(np.exp(self.position[2]))

    def moved(self, step: np.ndarray) -> "FitState":
        """The state after a step."""
        first_shape = 6 + len(self.angles)
        return replace(
            self,
            rotation=cv2.Rodrigues(step[:3])[0] @ self.rotation,
            position=self.position + step[3:6],
            angles=self.angles + step[6:first_shape],
            shape=self.shape + step[first_shape:-1],
            focal=self.focal * float(np.exp(step[-1])),
        )

    def in_camera(self, points: np.ndarray) -> np.ndarray:
        """Points of the hand's frame in the camera's frame [m]."""
        return points @ self.rotation.T + self.translation()

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points of the hand's frame on the image [px]."""
        seen = self.in_camera(points)
        return self.focal * seen[:, :2] / seen[:, 2:] + self.centre

    def linearize(self, points: np.ndarray, derivative: np.ndarray) -> "Linearized":
        """Image and camera points with their derivatives by a step; `derivative` is that by (angles, shape)."""
        turned, translation = points @ self.rotation.T, self.translation()
        seen = turned + translation
        d_seen = np.zeros((len(points), 3, 7 + derivative.shape[2]))
        d_seen[:, 0, 1], d_seen[:, 0, 2] = turned[:, 2], -turned[:, 1]
        d_seen[:, 1, 0], d_seen[:, 1, 2] = -turned[:, 2], turned[:, 0]
        d_seen[:, 2, 0], d_seen[:, 2, 1] = turned[:, 1], -turned[:, 0]
        d_seen[:, 0, 3] = d_seen[:, 1, 4] = translation[2]
        d_seen[:, :, 5] = translation
        d_seen[:, :, 6:-1] = self.rotation @ derivative
        image = self.focal * seen[:, :2] / seen[:, 2:] + self.centre
        slope = (seen[:, :2] / seen[:, 2:])[..., None]
        d_image = (self.focal / seen[:, 2])[:, None, None] * (d_seen[:, :2] - d_seen[:, 2:] * slope)
        d_image[:, :, -1] = image - self.centre
        return Linearized(image, d_image, seen, d_seen)


@dataclass(frozen=True)
class Linearized:
    """Points in the image and in the camera's frame, and their derivatives by a step (last axis)."""

    image: np.ndarray
    d_image: np.ndarray
    seen: np.ndarray
    d_seen: np.ndarray


class MirroredInput:
    """A photo and one hand in it: mirrored for a left hand, reduced for a very large one."""

    def __init__(self, photo: Photo, landmarks: Landmarks, focal: float | None):
        self.name, self.mirrored = photo.name, landmarks.side == "left"
        rgb = photo.rgb.cpu().numpy()
        self.photo_size = rgb.shape[1], rgb.shape[0]
        factor = min(1.0, _LARGEST / max(box_size(array(landmarks.xy)), 1.0))
        size = (max(8, round(rgb.shape[1] * factor)), max(8, round(rgb.shape[0] * factor)))
        self.scale = np.array(size) / self.photo_size
        """Pixels of this input per pixel of the photo, in x and y."""
        landmarks = landmarks._replace(
            xy=landmarks.xy.double() * torch.from_numpy(self.scale),
            world=None if landmarks.world is None else landmarks.world.double(),
        )
        if self.mirrored:
            landmarks = mirror_landmarks(landmarks, size[0])
        self.rgb = self._resized(rgb, size)
        self.alpha = None if photo.alpha is None else self._resized(photo.alpha.cpu().numpy(), size)
        known = focal or photo.focal
        world = None if landmarks.world is None else array(landmarks.world)
        self.target = fit_target(array(landmarks.xy), world, size, known and known * float(self.scale[0]))

    def _resized(self, image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """An image [H, W, ...] of the photo, resized and mirrored as this input is."""
        if size != self.photo_size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(image[:, ::-1]) if self.mirrored else image

    def in_photo(self, mask: np.ndarray) -> np.ndarray:
        """A mask [h, w] of this input at the photo's size, not mirrored."""
        mask = mask[:, ::-1] if self.mirrored else mask
        if mask.shape[::-1] == self.photo_size:
            return mask
        return cv2.resize(np.ascontiguousarray(mask), self.photo_size, interpolation=cv2.INTER_LINEAR)

    def pose(self, kinematics: HandKinematics, state: FitState) -> HandPose:
        """The pose in the photo's own frame, float32."""
        parts = kinematics.all_angles(state.angles)[1:], state.rotation, state.translation()
        pose = HandPose(*map(torch.from_numpy, parts))
        return HandPose(*(part.float() for part in (mirror_pose(pose) if self.mirrored else pose)))

    def camera(self, state: FitState) -> Camera:
        """The camera of the photo."""
        K = np.array([[state.focal, 0, state.centre[0]], [0, state.focal, state.centre[1]], [0, 0, 1]])
        camera = Camera(torch.eye(4).double(), torch.from_numpy(K), *self.target.size)
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
    position = np.array([*(translation[:2] / translation[2]), np.log(translation[2])])
    angles = array(pose.angles)[kinematics.dofs[:, 0] - 1, kinematics.dofs[:, 1]]
    return FitState(array(pose.orientation), position, angles, shape, float(K[0, 0]), K[:2, 2])


def mirrored_fit(kinematics: HandKinematics, fit: HandFit) -> MirroredFit:
    """A fit as one of a right hand: the photo is mirrored for a left hand."""
    state = mirrored_state(kinematics, fit.side, array(fit.shape), fit.pose, fit.camera)
    xy, mask = fit.landmarks.xy.double(), fit.mask.detach().cpu()
    if fit.side == "left":
        xy, mask = mirror_pixels(xy, fit.camera.width), mask.flip(1)
    angles = np.concatenate([np.zeros((1, 3)), array(fit.pose.angles)])
    return MirroredFit(state, angles, array(xy), mask.numpy())
