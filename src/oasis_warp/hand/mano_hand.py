"""MANO as the hand of all stages: its surface in the triangulation of the bundled hand.

Networks, skin and textures know the bundled hand's vertices by number. So each of them gets its place on MANO-HD: the
bundled hand is posed and shaped onto MANO's template by least squares, then every vertex moves onto its surface as
smoothly as possible. Template, shapes, pose displacements and weights are read off there. Joints, shapes and poses stay
MANO's own, so its parameters pass in and out unchanged.
"""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from oasis_warp.core import surface
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel, ModelOrigin
from oasis_warp.core.rotation import euler_angles, euler_rotations
from oasis_warp.core.types import HandPose
from oasis_warp.hand.kinematics import HandKinematics, PosedJoints, bundled_kinematics, rotation_between, unit
from oasis_warp.hand.mano import (
    PARENTS,
    TIP_VERTICES,
    ManoModel,
    ManoPose,
    mano_hd,
    read_mano,
    rotation_vectors,
    rotations,
)
from oasis_warp.hand.template import bundled_hand

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
        sigma: Sigma of the distances [m].
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
        steps: Gauss-Newton steps on every fourth vertex.
    """
    index = np.arange(0, len(vertices), 4)
    if start is None:
        place = align(kinematics.template[index], vertices[index])
        start = PlacedHand(np.zeros((16, 3)), np.zeros(kinematics.shape_basis.shape[2]), *place)
    for _ in range(steps):
        start = step_to_points(kinematics, start, index, vertices[index])
    return start


FIT_STEPS = 30
_SAME_PLACE, _SAME_NORMAL, _SAME_BONE = 1.0, 0.01, 0.04
"""How far apart two places are: by distance, by unit normals, by skinning weights [m]. Without the last, sides of
neighbouring fingers would be confused."""
_STIFFNESS = (100.0, 30.0, 10.0, 3.0, 1.0, 0.3, 0.1)
"""Weights of smoothness over closeness, from round to round; as usual in non-rigid registration it falls."""
_NEAR_VERTICES = 3
"""Around which the nearest face of a point is looked for at last; edges of MANO-HD are 2 mm long."""
_RIM = 10.0
"""Weight of the wrist's rim."""
MAX_TURNED = 40.0
"""Largest rotation of the palm against the bundled hand's, which lies as MANO's [degrees]."""
WORST_FIT = 0.004
"""Root of the mean squared distance, after fitting, above which the template is no hand as MANO's [m]."""


class Registration(NamedTuple):
    """Where the vertices of the bundled hand lie on another surface."""

    face: np.ndarray
    """[V]."""
    shares: np.ndarray
    """Barycentric coordinates, [V, 3]."""
    placed: PlacedHand
    """The bundled hand that lies nearest to the surface."""
    fit_error: float
    """Root of the mean squared distance of its vertices to the surface [m]."""


@functools.cache
def mano_hand(folder: Path) -> HandModel:
    """MANO's right hand, with 12,337 vertices, 10 shapes and 135 pose correctives; its wrist at the origin.

    Raises:
        InputError: `read_mano`'s, or a template that is not shaped and oriented as MANO's.
    """
    model = read_mano(folder)
    return hand_of_mano(model, register(model))


def hand_of_mano(model: ManoModel, registration: Registration) -> HandModel:
    """A right `ManoModel` in the triangulation of the bundled hand."""
    bundled, fine, placed = bundled_hand(), mano_hd(model), registration.placed
    corners = fine.faces[registration.face]

    def at_vertices(values: np.ndarray) -> torch.Tensor:
        mixed = np.einsum("vc,vc...->v...", registration.shares, values[corners])
        return torch.from_numpy(np.ascontiguousarray(mixed, np.float32))

    def real(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    wrist = model.joints(np.zeros(10))[0]
    joints = model.joints(np.zeros(10)) - wrist
    joint_basis = np.einsum("jv,vks->jks", model.regressor, model.coarse_shapes)
    tips = model.coarse_template[list(TIP_VERTICES)] - wrist
    kinematics = bundled_kinematics()
    posed = placed.joints(kinematics)
    seen = kinematics.landmarks(posed)[0] @ placed.rotation.T + placed.translation - wrist
    own = np.concatenate([joints, tips])[bundled.keypoint_index.numpy()]
    frames = placed.rotation @ np.stack([posed.rotation[max(parent, 0)] for parent in PARENTS])
    weights = at_vertices(fine.weights)
    rest = real(placed.angles)
    axes = np.einsum("jak,jbk->jab", kinematics.axes, frames)
    # R - 1 in the basis of the axes instead of the hand's, so that it depends on the angles alone.
    correctives = fine.pose_basis.reshape(-1, 3, 15, 3, 3)
    correctives = np.einsum("vkjab,jca,jdb->vkjcd", correctives, axes[1:], axes[1:], optimize=True)
    return replace(
        bundled,
        name="mano",
        template=at_vertices(fine.template - wrist),
        weights=weights,
        shape_basis=at_vertices(fine.shape_basis),
        shape_names=tuple(f"beta{k}" for k in range(10)),
        joints=real(joints),
        joint_basis=real(joint_basis),
        tips=real(tips),
        tip_basis=real(model.coarse_shapes[list(TIP_VERTICES)]),
        pose_axes=real(axes),
        pose_limits=bundled.pose_limits - rest[..., None],
        rest_bend=bundled.rest_bend + rest[:, 0],
        origin=ModelOrigin(*map(torch.from_numpy, (placed.angles, seen - own, wrist))),
        corrective_basis=at_vertices(correctives.reshape(-1, 3, 135)),
        segment=weights.argmax(1),
        licence="MANO, mano.is.tue.mpg.de/license",
    )


def register(model: ManoModel) -> Registration:
    """Places of the bundled hand's vertices on MANO-HD of a right hand.

    Raises:
        InputError: the template is not shaped and oriented as MANO's.
    """
    fine, kinematics = mano_hd(model), bundled_kinematics()
    placed = _fitted(kinematics, model, fine)
    start = placed.vertices(kinematics)
    fit_error = float(np.sqrt(((_on_surface(start, fine)[1] - start) ** 2).sum(1).mean()))
    if fit_error > WORST_FIT:
        raise InputError(
            f"MANO's template: the bundled hand lies {1e3 * fit_error:.1f} mm from it, expected up to "
            f"{1e3 * WORST_FIT:.0f}; give MANO's own files, in metres, fingers to -x, palm to -y."
        )
    moved = _moved_onto(kinematics, fine, start)
    face, place = _on_surface(moved, fine, _NEAR_VERTICES)
    return Registration(face, _barycentrics(place, fine.template[fine.faces[face]]), placed, fit_error)


def _fitted(kinematics: HandKinematics, model: ManoModel, fine: ManoModel) -> PlacedHand:
    """The bundled hand at MANO's template: bones along its bones, then its surface on the surface."""
    placed = _along_bones(kinematics, model)
    tree = cKDTree(_features(fine.template, _normals(fine.template, fine.faces), fine.weights))
    normals = _normals(fine.template, fine.faces)
    index = np.setdiff1d(np.arange(0, len(kinematics.template), 5), kinematics.rim)
    for _ in range(FIT_STEPS):
        points = placed.vertices(kinematics)
        own = _features(points, _normals(points, kinematics.faces), kinematics.weights)[index]
        near = tree.query(own)[1]
        placed = step_to_points(kinematics, placed, index, fine.template[near], normals=normals[near])
    return placed


def _along_bones(kinematics: HandKinematics, model: ManoModel) -> PlacedHand:
    """The mean bundled hand with palm on palm and every bone turned by the least into the direction of MANO's."""
    goal = np.concatenate([model.joints(np.zeros(10)), model.coarse_template[list(TIP_VERTICES)]])
    own = np.concatenate([kinematics.joints, kinematics.hand.tips.double().numpy()])
    palm = [0, 1, 4, 7, 10, 13]
    rotation, translation = align(own[palm], goal[palm])
    turned = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
    if turned > MAX_TURNED:
        raise InputError(
            f"MANO's template: its palm is turned by {turned:.0f} degrees against the bundled hand's, expected up to "
            f"{MAX_TURNED:.0f}; give MANO's own files, fingers to -x, palm to -y, thumb to +z."
        )
    ends = bone_ends()
    world, angles = np.repeat(rotation[None], 16, 0), np.zeros((16, 3))
    for j in range(1, 16):
        parent = world[PARENTS[j]]
        before, after = unit(parent @ (own[ends[j]] - own[j])), unit(goal[ends[j]] - goal[j])
        axis = np.cross(before, after)
        angle = np.arctan2(np.linalg.norm(axis), before @ after)
        world[j] = rotations(unit(axis) * angle)[0] @ parent
        local = parent.T @ world[j]
        axes = kinematics.axes[j]
        angles[j] = euler_angles(torch.from_numpy(axes @ local @ axes.T)).numpy()
    return PlacedHand(angles, np.zeros(kinematics.shape_basis.shape[2]), rotation, translation)


def bone_ends() -> dict[int, int]:
    """Where the bone of each joint ends: a row of the joints followed by the five tips, from thumb to little finger."""
    inner = {joint: joint + 1 for joint in range(1, 16) if joint % 3}
    return inner | {joint: 16 + k for k, joint in enumerate(TIP_JOINTS)}


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return surface.vertex_normals(torch.from_numpy(points), torch.from_numpy(faces)).numpy()


def _features(points: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.concatenate([_SAME_PLACE * points, _SAME_NORMAL * normals, _SAME_BONE * weights], 1)


def _moved_onto(kinematics: HandKinematics, fine: ManoModel, start: np.ndarray) -> np.ndarray:
    """Vertices moved onto the surface and its rim, neighbours by much the same (Amberg et al. 2007, translations)."""
    n, faces = len(start), torch.from_numpy(kinematics.faces)
    edges = surface.mesh_edges(faces).numpy()
    rows = np.arange(len(edges))
    ones = np.ones(len(edges))
    incidence = sparse.csr_array((np.r_[ones, -ones], (np.r_[rows, rows], edges.T.ravel())), (len(edges), n))
    laplacian = (incidence.T @ incidence).tocsc()
    at_rim = surface.open_vertices(torch.from_numpy(fine.faces), len(fine.template)).numpy()[fine.faces].any(1)
    goal_normals = np.cross(*(fine.template[fine.faces[:, k]] - fine.template[fine.faces[:, 0]] for k in (1, 2)))
    rim_goal = _rim_goal(start[kinematics.rim], fine)
    moved = start
    for stiffness in _STIFFNESS:
        face, place = _on_surface(moved, fine)
        agrees = (unit(goal_normals[face]) * _normals(moved, kinematics.faces)).sum(1) > 0.5
        weight = (agrees & ~at_rim[face]).astype(np.float64)
        goal = place.copy()
        goal[kinematics.rim], weight[kinematics.rim] = rim_goal, _RIM
        solver = splu((stiffness * laplacian + sparse.diags_array(weight)).tocsc())
        moved = start + solver.solve(weight[:, None] * (goal - start))
    return moved


def _on_surface(points: np.ndarray, fine: ManoModel, n_near: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """The nearest face of each point, [P], and the place on it, [P, 3]; of the faces around its nearest vertices."""
    near = cKDTree(fine.template).query(points, range(1, n_near + 1))[1]
    around = surface.faces_of_vertices(torch.from_numpy(fine.faces), len(fine.template)).numpy()
    faces = around[near].reshape(len(points), -1)
    faces = np.where(faces < len(fine.faces), faces, faces[:, :1])  # rows are filled up with one past the last face
    places = _nearest_in_triangles(points[:, None], fine.template[fine.faces[faces]])
    best = ((places - points[:, None]) ** 2).sum(2).argmin(1)
    rows = np.arange(len(points))
    return faces[rows, best], places[rows, best]


def _nearest_in_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The point of each triangle, [P, M, 3, 3], that is nearest to a point, [P, 1, 3]: inside it or on an edge."""
    starts, edges = corners, np.roll(corners, -1, axis=2) - corners
    along = ((points[:, :, None] - starts) * edges).sum(-1) / (edges**2).sum(-1).clip(1e-30)
    on_edges = starts + along.clip(0, 1)[..., None] * edges
    nearest = ((on_edges - points[:, :, None]) ** 2).sum(-1).argmin(2)
    on_edge = np.take_along_axis(on_edges, nearest[..., None, None], 2)[:, :, 0]
    normal = unit(np.cross(edges[:, :, 0], edges[:, :, 1]))
    in_plane = points - ((points - starts[:, :, 0]) * normal).sum(-1, keepdims=True) * normal
    side = (np.cross(edges, in_plane[:, :, None] - starts) * normal[:, :, None]).sum(-1)
    return np.where((side >= 0).all(2, keepdims=True), in_plane, on_edge)


def _rim_goal(rim: np.ndarray, fine: ManoModel) -> np.ndarray:
    """Points of MANO's rim in the same directions from its centre, about the wrist's axis x."""
    is_open = surface.open_vertices(torch.from_numpy(fine.faces), len(fine.template)).numpy()
    loop = fine.template[is_open]
    angle = np.arctan2(*(loop - loop.mean(0))[:, 1:].T)
    order = np.argsort(angle)
    wanted = np.arctan2(*(rim - rim.mean(0))[:, 1:].T)
    return np.stack([np.interp(wanted, angle[order], loop[order, k], period=2 * np.pi) for k in range(3)], 1)


def _barycentrics(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    a, b, c = corners.transpose(1, 0, 2)
    areas = np.stack([np.cross(c - b, points - b), np.cross(a - c, points - c), np.cross(b - a, points - a)], 1)
    whole = np.cross(b - a, c - a)
    shares = (areas * whole[:, None]).sum(2) / (whole**2).sum(1, keepdims=True)
    shares = shares.clip(0, 1)
    return shares / shares.sum(1, keepdims=True)


# ---- parameters


def hand_pose_of_mano(hand: HandModel, pose: ManoPose) -> HandPose:
    """MANO's parameters of a right hand as a pose of `mano_hand`, float64; the shape is `pose.betas`."""
    matrices = torch.from_numpy(rotations(np.concatenate([pose.global_orient.reshape(1, 3), pose.hand_pose])))
    axes = hand.pose_axes.double().cpu()[1:]
    wrist, moved = _wrist(hand, pose.betas)
    translation = wrist + torch.from_numpy(pose.transl) - matrices[0] @ moved
    return HandPose(euler_angles(axes @ matrices[1:] @ axes.mT), matrices[0], translation)


def mano_of_hand_pose(hand: HandModel, shape: torch.Tensor, pose: HandPose) -> ManoPose:
    """MANO's parameters of a right hand's shape and pose: the inverse of `hand_pose_of_mano`."""
    shape, angles, orientation, translation = (part.double().cpu() for part in (shape, *pose))
    axes = hand.pose_axes.double().cpu()[1:]
    matrices = torch.cat([orientation[None], axes.mT @ euler_rotations(angles) @ axes]).numpy()
    vectors = rotation_vectors(matrices)
    wrist, moved = _wrist(hand, shape.numpy())
    return ManoPose(shape.numpy(), vectors[0], vectors[1:], (translation - wrist + orientation @ moved).numpy())


def _wrist(hand: HandModel, betas: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """The wrist at rest in the frame of MANO's file, and what the shape moves it by; the hand's frame has it at 0."""
    if hand.origin is None:
        raise ValueError(f"hand: expected MANO's, got {hand.name!r}. mano_hand gives it.")
    moved = hand.joint_basis[0].double().cpu() @ torch.from_numpy(betas)
    return hand.origin.wrist + moved, moved
