"""Landmarks and vertices of the right hand with their derivatives by joint angles and shape, in numpy float64.

The forward kinematics of `skinning`, for the least-squares fit. It has 26 angles instead of 45, because the middle and
end joints of fingers only flex. The wrist does not move, because the fit's camera moves instead.
"""

import functools
from dataclasses import dataclass

import numpy as np
import torch

from oasis_warp.core import surface
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel
from oasis_warp.hand.skinning import corrective_coefficients
from oasis_warp.hand.template import bundled_hand

# Offsets of the network's landmarks from the hand's joints and tips, in millimetres on a hand of 190 mm: along the bone
# to the tip, towards the back of the hand, and along the cross product of both. From least squares over 63 photos, then
# over a third of them with the pose correctives, rounded to half a millimetre, because further passes only trade
# offsets for shape. Tips are detected 3 to 4 mm short, the thumb's root lies 9 mm away, ring and little knuckles
# lie deeper.
_LANDMARK_OFFSETS = np.array([
    [3.5, -0.5, -0.5], [4, 4, -8.5], [-1, 0, 0.5], [0.5, -4, 0], [-3.5, -1, -0.5],
    [0.5, -1.5, 2.5], [1, -0.5, 0.5], [2, -2.5, -1], [-3.5, -1, 0],
    [0.5, -3, -0.5], [1, -1.5, -1.5], [0.5, -1, -0.5], [-4.5, -0.5, -1],
    [2, -4, -2], [1.5, -0.5, 0], [2.5, -1.5, 0], [-4, 0, -2],
    [1.5, -4, -2], [0, -0.5, 0], [2.5, -1, 0], [-3.5, -0.5, -1.5],
])  # fmt: skip


@dataclass(frozen=True)
class PosedJoints:
    """The joints in one pose and shape."""

    angles: np.ndarray
    """All angles [rad], [16, 3]."""
    shape: np.ndarray
    """Shape coefficients, [S]."""
    rest: np.ndarray
    """Joints of the unposed hand, [16, 3]."""
    rotation: np.ndarray
    """Bone to hand, [16, 3, 3]."""
    position: np.ndarray
    """Posed joints, [16, 3]."""
    position_by_shape: np.ndarray
    """[16, 3, S]."""
    axes: np.ndarray
    """Posed axes of flexion, abduction and twist, [16, 3, 3]."""


class HandKinematics:
    """A `HandModel` in float64 numpy, with the tables that the derivatives need."""

    def __init__(self, hand: HandModel):
        def real(tensor: torch.Tensor) -> np.ndarray:
            return tensor.detach().cpu().numpy().astype(np.float64)

        self.hand = hand
        self.parents = hand.parents
        self.joints, self.joint_basis = real(hand.joints), real(hand.joint_basis)
        self.axes, self.limits, self.rest_bend = real(hand.pose_axes), real(hand.pose_limits), real(hand.rest_bend)
        self.template, self.shape_basis = real(hand.template), real(hand.shape_basis)
        self.corrective_basis = real(hand.corrective_basis).reshape(-1, hand.corrective_basis.shape[2])
        self.weights = real(hand.weights)
        self.faces = hand.faces.cpu().numpy().astype(np.int64)
        self.rim = hand.rim.cpu().numpy()
        self.rest_normals = self.vertex_normals(self.template)
        keypoints = hand.keypoint_index.cpu().numpy()
        self.points = np.concatenate([self.joints, real(hand.tips)])[keypoints]
        self.points_basis = np.concatenate([self.joint_basis, real(hand.tip_basis)])[keypoints]
        self.point_joint = np.concatenate([np.arange(16), TIP_JOINTS])[keypoints]
        self.offsets = self._landmark_offsets() if hand.origin is None else real(hand.origin.landmark_offsets)
        self.dofs = np.array([(j, a) for j in range(1, 16) for a in self._free_axes(j)])
        """Joint and axis of each of the 26 angles."""
        self.below = np.zeros((16, 16))
        """below[a, j] is 1 if j is a or a descendant of a."""
        for j in range(16):
            a = j
            while a >= 0:
                self.below[a, j] = 1
                a = self.parents[a]
        depth = self.below.sum(0)
        self.levels = [np.flatnonzero(depth == level) for level in range(2, int(depth.max()) + 1)]
        """Joints below the wrist, then those below them, and so on."""
        self.turns = cross_matrices(unit(self.axes))
        """Of the axes, [16, 3, 3, 3]."""

    @staticmethod
    def _free_axes(joint: int) -> tuple[int, ...]:
        thumb, place = joint >= 13, (joint - 1) % 3
        return ((0, 1, 2), (0, 1) if thumb else (0,), (0,))[place]

    def _landmark_offsets(self) -> np.ndarray:
        size = np.linalg.norm(self.points[12] - self.points[0])
        frames = np.zeros((21, 3, 3))
        frames[0] = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]
        for k in range(1, 21):
            start, end = (k - 1, k) if k % 4 == 0 else (k, k + 1)
            along = unit(self.points[end] - self.points[start])
            back = unit(np.cross(along, self.axes[self.point_joint[k], 0]))
            frames[k] = along, back, np.cross(along, back)
        return np.einsum("kab,ka->kb", frames, _LANDMARK_OFFSETS / 190 * size)

    def all_angles(self, angles: np.ndarray) -> np.ndarray:
        """The 26 angles in a table of all angles, [16, 3]; such a table as it is."""
        if angles.shape == (16, 3):
            return angles
        table = np.zeros((16, 3))
        table[self.dofs[:, 0], self.dofs[:, 1]] = angles
        return table

    def pose_joints(self, angles: np.ndarray, shape: np.ndarray) -> PosedJoints:
        """Pose the joints by the 26 angles of the fit, or by all, [16, 3]."""
        return self.pose_all_joints(self.all_angles(angles), shape)

    def pose_all_joints(self, table: np.ndarray, shape: np.ndarray) -> PosedJoints:
        """Pose the joints by all angles, [16, 3]."""
        rest = self.joints + self.joint_basis @ shape
        rotation, position = np.zeros((16, 3, 3)), np.zeros((16, 3))
        by_shape, axes = np.zeros((16, 3, len(shape))), np.zeros((16, 3, 3))
        rotation[0], position[0], by_shape[0] = np.eye(3), rest[0], self.joint_basis[0]
        angles = (table * np.linalg.norm(self.axes, axis=2))[..., None, None]
        about = np.eye(3) + np.sin(angles) * self.turns + (1 - np.cos(angles)) * (self.turns @ self.turns)
        before = np.stack([np.broadcast_to(np.eye(3), (16, 3, 3)), about[:, 0], about[:, 0] @ about[:, 1]], 1)
        bent, own_axes = before[:, 2] @ about[:, 2], (before @ self.axes[..., None])[..., 0]
        for own in self.levels:
            parent = np.array(self.parents)[own]
            frame = rotation[parent]
            position[own] = position[parent] + (frame @ (rest[own] - rest[parent])[..., None])[..., 0]
            by_shape[own] = by_shape[parent] + frame @ (self.joint_basis[own] - self.joint_basis[parent])
            axes[own] = own_axes[own] @ frame.transpose(0, 2, 1)
            rotation[own] = frame @ bent[own]
        return PosedJoints(table, shape, rest, rotation, position, by_shape, axes)

    def landmarks(self, joints: PosedJoints) -> tuple[np.ndarray, np.ndarray]:
        """The 21 landmarks as the network detects them [m], [21, 3], and d landmarks / d (angles, shape)."""
        joint, dof_joint = self.point_joint, self.dofs[:, 0]
        local = self.points + self.points_basis @ joints.shape - joints.rest[joint] + self.offsets
        frame = joints.rotation[joint]
        points = (frame @ local[..., None])[..., 0] + joints.position[joint]
        arm = points[:, None] - joints.position[dof_joint]
        by_angle = np.cross(joints.axes[tuple(self.dofs.T)], arm) * self.below[dof_joint][:, joint].T[..., None]
        by_shape = frame @ (self.points_basis - self.joint_basis[joint]) + joints.position_by_shape[joint]
        return points, np.concatenate([by_angle.transpose(0, 2, 1), by_shape], 2)

    def rest_surface(self, shape: np.ndarray) -> np.ndarray:
        """Vertices at rest [m], without pose correctives."""
        return self.template + (self.shape_basis.reshape(-1, len(shape)) @ shape).reshape(-1, 3)

    def correctives(self, table: np.ndarray) -> np.ndarray:
        """Displacement of the rest surface by the pose correctives of all angles ([16, 3]) [m], [V, 3]."""
        strengths = corrective_coefficients(self.hand, torch.from_numpy(table[1:])).numpy()
        return (self.corrective_basis @ strengths).reshape(-1, 3)

    def surface(self, joints: PosedJoints) -> np.ndarray:
        """The posed surface, correctives included [m], [V, 3]."""
        return self.pose_surface(joints, self.rest_surface(joints.shape) + self.correctives(joints.angles))

    def bone_shifts(self, joints: PosedJoints) -> np.ndarray:
        """Translations of the bone transforms whose rotations are `joints.rotation`, [16, 3]."""
        return joints.position - (joints.rotation @ joints.rest[..., None])[..., 0]

    def blended(self, joints: PosedJoints, index: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Blended bone rotation of each vertex, [V, 3, 3]."""
        return (self.weights[index] @ joints.rotation.reshape(16, 9)).reshape(-1, 3, 3)

    def pose_surface(self, joints: PosedJoints, rest: np.ndarray) -> np.ndarray:
        """Linear blend skinning of the whole rest surface."""
        return (self.blended(joints) @ rest[..., None])[..., 0] + self.weights @ self.bone_shifts(joints)

    def vertex_normals(self, vertices: np.ndarray) -> np.ndarray:
        """Unit area-weighted normals of the vertices, [V, 3]."""
        return surface.vertex_normals(torch.from_numpy(vertices), self.hand.faces).numpy()

    def places(self, joints: PosedJoints, index: np.ndarray, displacement: np.ndarray | float = 0.0) -> np.ndarray:
        """Posed vertices `index` [m], [P, 3], after a `displacement` at rest."""
        rest = self.template[index] + self.shape_basis[index] @ joints.shape + displacement
        return (self.blended(joints, index) @ rest[..., None])[..., 0] + self.weights[index] @ self.bone_shifts(joints)

    def vertices(
        self, joints: PosedJoints, index: np.ndarray, displacement: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`places` and d places / d (angles, shape); the `displacement` [P, 3] stays constant."""
        basis = self.shape_basis[index]
        start, weights = self.template[index] + basis @ joints.shape + displacement, self.weights[index]
        shares = (start @ joints.rotation.reshape(48, 3).T + self.bone_shifts(joints).ravel()) * weights.repeat(3, 1)
        slopes, at_joints = self._slopes_of_shares(joints)
        by_angle = shares @ slopes - weights @ at_joints
        shift_by_shape = joints.position_by_shape - joints.rotation @ self.joint_basis
        by_shape = self.blended(joints, index) @ basis + np.tensordot(weights, shift_by_shape, 1)
        return shares.reshape(-1, 16, 3).sum(1), np.concatenate([by_angle.reshape(-1, 3, len(self.dofs)), by_shape], 2)

    def normals(self, joints: PosedJoints, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Posed normals of vertices of the mean hand, [P, 3], and d normals / d angles, [P, 3, 26]."""
        shares = (self.rest_normals[index] @ joints.rotation.reshape(48, 3).T) * self.weights[index].repeat(3, 1)
        normals = shares.reshape(-1, 16, 3).sum(1)
        length = np.linalg.norm(normals, axis=1)[:, None]
        normals, by_angle = normals / length, shares @ self._slopes_of_shares(joints)[0] / length
        by_angle = by_angle.reshape(-1, 3, len(self.dofs))
        return normals, by_angle - normals[..., None] * (normals[:, None] @ by_angle)

    def _slopes_of_shares(self, joints: PosedJoints) -> tuple[np.ndarray, np.ndarray]:
        """Slopes by the angles of the bones' parts of a place, [48, 3 * 26], and of their weights, [16, 3 * 26].

        Each part turns about the joint of the angle if its bone descends from that.
        """
        joint, below = self.dofs[:, 0], self.below[self.dofs[:, 0]].T
        turns = cross_matrices(joints.axes[tuple(self.dofs.T)]).transpose(2, 1, 0)  # from, to, angle
        at_joints = (turns * joints.position[joint].T[:, None]).sum(0)
        return (below[:, None, None] * turns).reshape(48, -1), (below[:, None] * at_joints).reshape(16, -1)


@functools.cache
def bundled_kinematics() -> HandKinematics:
    """Kinematics of the bundled mean hand."""
    return HandKinematics(bundled_hand())


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Matrices that take the cross product of each vector with another one, [..., 3, 3]."""
    matrices = np.zeros((*vectors.shape, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrices[..., b, a], matrices[..., a, b] = vectors[..., c], -vectors[..., c]
    return matrices


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors at length one; a zero vector stays."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotation that carries the points `a` best onto `b`, after centring (Kabsch 1976)."""
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
