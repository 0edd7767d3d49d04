"""Shape, pose and place of a hand model whose vertices lie nearest to given points, by least squares."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from oasis_warp.hand.kinematics import HandKinematics, PosedJoints, rotation_between

ROUGH_ANGLE, ROUGH_SHAPE = 1.0, 3.0
"""Sigmas of angles [rad] and shape coefficients: weak, to hold what points do not tell."""
_DAMPING = 1e-6
_FAR = 3.0
"""Residual, in sigmas, from which points count for less (Geman and McClure)."""


@dataclass(frozen=True)
class PlacedHand:
    """A hand in the frame of the points."""

    angles: np.ndarray
    """All angles [rad], [16, 3]."""
    shape: np.ndarray
    """[S]."""
    rotation: np.ndarray
    """Hand to points, [3, 3]."""
    translation: np.ndarray
    """[m], [3]."""

    def joints(self, kinematics: HandKinematics) -> PosedJoints:
        """In the frame of the hand."""
        return kinematics.pose_all_joints(self.angles, self.shape)

    def vertices(self, kinematics: HandKinematics) -> np.ndarray:
        """The surface with pose correctives, in the frame of the points [m], [V, 3]."""
        return kinematics.surface(self.joints(kinematics)) @ self.rotation.T + self.translation


def align(points: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and translation that bring points nearest to others, row by row."""
    rotation = rotation_between(points, to)
    return rotation, to.mean(0) - rotation @ points.mean(0)


def step_to_points(
    kinematics: HandKinematics, hand: PlacedHand, index: np.ndarray, points: np.ndarray, *,
    normals: np.ndarray | None = None, sigma: float = 1e-3,
) -> PlacedHand:  # fmt: skip
    """One damped Gauss-Newton step of place, the 26 angles of the fit and shape; other angles stay.

    Args:
        kinematics: The hand model.
        hand: Where it is.
        index: Vertices, [P].
        points: Where they should lie [m], [P, 3].
        normals: Count only distances along these, [P, 3].
        sigma: Of the distances [m].
    """
    joints, dofs = hand.joints(kinematics), tuple(kinematics.dofs.T)
    moved = kinematics.correctives(hand.angles)[index]
    local, by_hand = kinematics.vertices(joints, index, moved)
    n = 6 + by_hand.shape[2]
    jacobian = np.zeros((len(index), 3, n))
    turned = local @ hand.rotation.T
    jacobian[:, 0, 1], jacobian[:, 0, 2] = turned[:, 2], -turned[:, 1]
    jacobian[:, 1, 0], jacobian[:, 1, 2] = -turned[:, 2], turned[:, 0]
    jacobian[:, 2, 0], jacobian[:, 2, 1] = turned[:, 1], -turned[:, 0]
    jacobian[:, :, 3:6] = np.eye(3)
    jacobian[:, :, 6:] = hand.rotation @ by_hand
    residual = turned + hand.translation - points
    if normals is not None:
        residual = (residual * normals).sum(1, keepdims=True)
        jacobian = (normals[:, None] @ jacobian)
    squared = (residual**2).sum(1) / sigma**2
    weight = (1 + squared / _FAR**2) ** -1 / sigma
    residual, jacobian = (residual * weight[:, None]).ravel(), (jacobian * weight[:, None, None]).reshape(-1, n)
    held = np.concatenate([hand.angles[dofs] / ROUGH_ANGLE**2, hand.shape / ROUGH_SHAPE**2])
    stiff = np.concatenate([np.zeros(6), np.full(len(dofs[0]), ROUGH_ANGLE**-2.0),
                            np.full(len(hand.shape), ROUGH_SHAPE**-2.0)])  # fmt: skip
    normal = jacobian.T @ jacobian + np.diag(stiff)
    normal += _DAMPING * np.diag(normal.diagonal() + 1)
    step = -np.linalg.solve(normal, jacobian.T @ residual + np.concatenate([np.zeros(6), held]))
    angles = hand.angles.copy()
    angles[dofs] += step[6 : 6 + len(dofs[0])]
    return replace(
        hand,
        angles=angles,
        shape=hand.shape + step[6 + len(dofs[0]) :],
        rotation=cv2.Rodrigues(step[:3])[0] @ hand.rotation,
        translation=hand.translation + step[3:6],
    )


def fit_vertices(
    kinematics: HandKinematics, vertices: np.ndarray, start: PlacedHand | None = None, steps: int = 20
) -> PlacedHand:
    """The hand whose vertices lie nearest to as many points: any other model's surface in the same triangulation.

    Args:
        kinematics: The hand model.
        vertices: Points [m], [V, 3].
        start: Where to start; at rest, aligned with the points, when not given.
        steps: Of Gauss and Newton, on every fourth vertex.
    """
    index = np.arange(0, len(vertices), 4)
    if start is None:
        place = align(kinematics.template[index], vertices[index])
        start = PlacedHand(np.zeros((16, 3)), np.zeros(kinematics.shape_basis.shape[2]), *place)
    for _ in range(steps):
        start = step_to_points(kinematics, start, index, vertices[index])
    return start
