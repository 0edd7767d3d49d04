"""What the fit solves for, the hand before a pinhole camera, and how image points move with it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np


@dataclass(frozen=True)
class FitState:
    """Unknowns of the fit. A step is (turn 3, place 3, angles 26, shape S, log focal 1)."""

    turn: np.ndarray
    """Hand to camera, [3, 3]; steps are multiplied from the left."""
    place: np.ndarray
    """(x / z, y / z, log z) of the wrist: independent of the hand's size where the picture is."""
    angles: np.ndarray
    shape: np.ndarray
    focal: float
    """[px]."""
    centre: np.ndarray
    """Principal point [px], held."""

    def translation(self) -> np.ndarray:
        """The wrist in the camera's frame [m]."""
        return np.exp(self.place[2]) * np.array([self.place[0], self.place[1], 1.0])

    def moved(self, step: np.ndarray) -> "FitState":
        """The state after a step."""
        first_shape = 6 + len(self.angles)
        return replace(
            self,
            turn=cv2.Rodrigues(step[:3])[0] @ self.turn,
            place=self.place + step[3:6],
            angles=self.angles + step[6:first_shape],
            shape=self.shape + step[first_shape:-1],
            focal=self.focal * float(np.exp(step[-1])),
        )

    def in_camera(self, points: np.ndarray) -> np.ndarray:
        """Points of the hand's frame in the camera's frame [m]."""
        return points @ self.turn.T + self.translation()

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points of the hand's frame on the image [px]."""
        seen = self.in_camera(points)
        return self.focal * seen[:, :2] / seen[:, 2:] + self.centre

    def linearize(self, points: np.ndarray, derivative: np.ndarray) -> "Linearized":
        """Image and camera points with their derivatives by a step; `derivative` is by (angles, shape)."""
        turned, translation = points @ self.turn.T, self.translation()
        seen = turned + translation
        d_seen = np.zeros((len(points), 3, 7 + derivative.shape[2]))
        d_seen[:, 0, 1], d_seen[:, 0, 2] = turned[:, 2], -turned[:, 1]
        d_seen[:, 1, 0], d_seen[:, 1, 2] = -turned[:, 2], turned[:, 0]
        d_seen[:, 2, 0], d_seen[:, 2, 1] = turned[:, 1], -turned[:, 0]
        d_seen[:, 0, 3] = d_seen[:, 1, 4] = translation[2]
        d_seen[:, :, 5] = translation
        d_seen[:, :, 6:-1] = self.turn @ derivative
        image = self.focal * seen[:, :2] / seen[:, 2:] + self.centre
        slope = (seen[:, :2] / seen[:, 2:])[..., None]
        d_image = (self.focal / seen[:, 2])[:, None, None] * (d_seen[:, :2] - d_seen[:, 2:] * slope)
        d_image[:, :, -1] = image - self.centre
        return Linearized(image, d_image, seen, d_seen)


@dataclass(frozen=True)
class Linearized:
    """Points seen by the camera, and their derivatives by a step (last axis)."""

    image: np.ndarray
    d_image: np.ndarray
    seen: np.ndarray
    d_seen: np.ndarray
