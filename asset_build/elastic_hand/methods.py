"""Ways to skin a hand that are cheaper than flesh: dual quaternions, delta mush, pose shapes fitted to flesh.

The shapes that ship follow flesh on bones and keep the parts of a hand out of each other (`fit_to_flesh`). They are a
ridge regression of the flesh's displacements on the strengths of the shapes, and of contact: where the posed surface
lies inside another part of itself, both sides have to give way by half, in poses without simulated flesh too. Each
round adds targets for what is still inside; earlier targets stay.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
import torch
from hand_build.anatomy import FINGERS, FIRST, Array, Index
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from elastic_hand.solid import MILLIMETRES, skinned
from elastic_hand.truths import Truth, bones
from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.correctives import corrective_coefficients

RIDGES = (1e-3, 1e-2, 1e-1, 1.0)
FOLDS = 4
Features = Callable[[Array], Array]
"""Joint angles [15, 3] to strengths [C]."""
RIDGE = 1.0
ELSEWHERE = 1e6
"""Ridge of a shape on a finger that is not its own nor beside it."""
NAIL_BED, NAIL_FREE = 3.0, 8.0
"""Distances from a nail up to which skin keeps to the bone, and from which on it is free of it [mm]."""
POSE_WEIGHT = 2.0
"""Of a state in which several joints are bent, against one joint bent alone."""
CONTACT_WEIGHT = 10.0
"""Of giving way at a vertex in a pose, against following the flesh of one joint there."""
ROUNDS = 5
NEIGHBOURS = 24
APART, DEEPEST, MARGIN = 5.0, 8.0, 0.2
"""Skin touches skin that is at least so far off at rest, is at most so deep inside, and is moved so far out [mm]."""
OPPOSED = -0.3
"""Cosine of the normals of skin that touches, at most."""


def dual_quaternions(points: Array, weights: Array, bones: Array) -> Array:
    """Points carried by blended dual quaternions (Kavan et al. 2008), [V, 3]."""
    real = Rotation.from_matrix(bones[:, :, :3]).as_quat(scalar_first=True)
    dual = _times(np.concatenate([np.zeros((16, 1)), bones[:, :, 3]], 1), real) / 2
    main = real[weights.argmax(1)]
    signed = weights * np.where(main @ real.T < 0, -1, 1)
    blend, shift = signed @ real, signed @ dual
    length = np.linalg.norm(blend, axis=1, keepdims=True)
    blend, shift = blend / length, shift / length
    translation = 2 * _times(shift, blend * [1, -1, -1, -1])[:, 1:]
    return Rotation.from_quat(blend, scalar_first=True).apply(points) + translation


def _times(a: Array, b: Array) -> Array:
    """Product of quaternions, real part first."""
    real = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    return np.concatenate(
        [real, a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])], -1
    )


class DeltaMush:
    """Smooth the skinned surface and put back the detail that smoothing takes from the rest (Mancewicz et al. 2014)."""

    def __init__(self, rest: Array, faces: Index, rim: Index, rounds: int) -> None:
        n, near = len(rest), igl.adjacency_matrix(faces)
        mean = sp.diags(1 / np.asarray(near.sum(1))[:, 0]) @ near
        moves = np.ones(n)
        moves[rim] = 0
        self.operator = (sp.diags(1 - moves / 2) + sp.diags(moves / 2) @ mean).tocsr()
        self.rounds, self.faces = rounds, faces
        self._neighbour = np.zeros(n, np.int64)
        self._neighbour[faces] = np.roll(faces, 1, 1)
        smooth = self._smoothed(rest)
        self._delta = (self._frames(smooth).swapaxes(1, 2) @ (rest - smooth)[..., None])[..., 0]

    def __call__(self, surface: Array) -> Array:
        """The surface, mushed, [V, 3]."""
        smooth = self._smoothed(surface)
        return smooth + (self._frames(smooth) @ self._delta[..., None])[..., 0]

    def _smoothed(self, surface: Array) -> Array:
        for _ in range(self.rounds):
            surface = self.operator @ surface
        return surface

    def _frames(self, surface: Array) -> Array:
        """Normal, and two directions along the surface, as columns, [V, 3, 3]."""
        normal = np.asarray(igl.per_vertex_normals(surface, self.faces))
        along = surface[self._neighbour] - surface
        along -= (along * normal).sum(1, keepdims=True) * normal
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        return np.stack([normal, along, np.cross(normal, along)], 2)


@dataclass(frozen=True)
class PoseShapes:
    """Displacements of the rest surface by features of the pose."""

    features: Features
    basis: Array
    """[C, V, 3]."""

    def displacement(self, angles: Array) -> Array:
        """[V, 3]."""
        return np.tensordot(self.features(angles), self.basis, 1)


def flexion_features(hand: HandModel) -> Features:
    """Those of the product: c and c^2 of each joint, c = 1 - cos(flexion)."""
    return lambda angles: corrective_coefficients(hand, torch.from_numpy(angles)).numpy()


def wide_features(hand: HandModel) -> Features:
    """Those of the product, sines of flexion, and sines of the roots' abduction, their squares, and of twist."""
    narrow = flexion_features(hand)
    roots = [joint - 1 for joint in FIRST.values()]

    def features(angles: Array) -> Array:
        sines = np.sin(angles)
        sides = sines[roots, 1]
        return np.concatenate([narrow(angles), sines[:, 0], sides, sides**2, sines[roots, 2]])

    return features


def fit_shapes(features: Features, angles: Array, wanted: Array, groups: Index) -> PoseShapes:
    """Ridge regression of displacements on features; its strength by folds that part no group.

    Args:
        features: Of a pose.
        angles: [K, 15, 3].
        wanted: Displacements of the rest surface, [K, V, 3].
        groups: States with the same number are one bend, [K].
    """
    inputs = np.stack([features(a) for a in angles])
    scale = inputs.std(0) + 1e-9
    inputs, flat = inputs / scale, wanted.reshape(len(wanted), -1)

    def solved(rows: Array, ridge: float) -> Array:
        x = inputs[rows]
        return np.linalg.solve(x.T @ x + ridge * np.eye(x.shape[1]), x.T @ flat[rows])

    def error(ridge: float) -> float:
        total = 0.0
        for fold in range(FOLDS):
            out = groups % FOLDS == fold
            total += float(((inputs[out] @ solved(~out, ridge) - flat[out]) ** 2).sum())
        return total

    ridge = min(RIDGES, key=error)
    basis = solved(np.ones(len(inputs), bool), ridge) / scale[:, None]
    return PoseShapes(features, basis.reshape(-1, *wanted.shape[1:]))


def low_rank(shapes: PoseShapes, rank: int) -> PoseShapes:
    """The nearest shapes that move the surface along `rank` displacements only."""
    flat = shapes.basis.reshape(len(shapes.basis), -1)
    u, s, vt = np.linalg.svd(flat, full_matrices=False)
    mix = u[:, :rank] * s[:rank]
    features = shapes.features
    return PoseShapes(lambda angles: features(angles) @ mix, vt[:rank].reshape(rank, *shapes.basis.shape[1:]))


def unposed(surface: Array, rest: Array, weights: Array, bones: Array) -> Array:
    """The displacement of the rest surface that blend skinning carries to `surface`, [V, 3]."""
    blend = np.tensordot(weights, bones, 1)
    return np.linalg.solve(blend[:, :, :3], (surface - blend[:, :, 3])[..., None])[..., 0] - rest


def fit_to_flesh(
    hand: HandModel, subdivision: sp.csr_matrix, learnt: Sequence[Truth], others: Sequence[Array]
) -> Array:
    """Displacements of the coarse vertices by each shape [mm], [C, n, 3].

    Args:
        hand: float64.
        subdivision: Coarse vertices to the hand's.
        learnt: What flesh does.
        others: Angles [15, 3] of more poses, in which nothing shall lie inside.
    """
    rest, weights, faces = hand.template.numpy() * MILLIMETRES, hand.weights.numpy(), hand.faces.numpy()
    features = flexion_features(hand)
    states = [(a, v * MILLIMETRES) for t in learnt for a, v in zip(t.angles, t.vertices, strict=True)]
    strengths = np.stack([features(a) for a, _ in states])
    scale = np.sqrt((strengths**2).mean(0))
    inputs = strengths / scale
    wanted = np.stack([unposed(v, rest, weights, bones(hand, a)) for a, v in states])
    together = np.array([np.count_nonzero(a[:, 0]) > 1 for a, _ in states])
    weighted = inputs * np.where(together, POSE_WEIGHT, 1.0)[:, None]
    left = np.broadcast_to(weighted.T @ inputs + RIDGE * np.eye(inputs.shape[1]), (len(rest), *[inputs.shape[1]] * 2))
    left = left + np.eye(inputs.shape[1]) * np.where(_within_reach(hand), 0, ELSEWHERE)[:, None]
    right = np.tensordot(weighted.T, wanted, 1).transpose(1, 0, 2)

    coarse = scipy.sparse.linalg.splu((subdivision.T @ subdivision).tocsc())
    to_nail, _ = cKDTree(rest[hand.nail.numpy() > 0.5]).query(coarse.solve(subdivision.T @ rest))
    free = np.clip((to_nail - NAIL_BED) / (NAIL_FREE - NAIL_BED), 0, 1)[:, None]  # nails are rigid

    def solved(left: Array, right: Array) -> tuple[Array, Array]:
        """Of the coarse vertices, and what that is on the hand's."""
        fine = (np.linalg.solve(left, right) / scale[:, None]).transpose(1, 0, 2)
        found = np.stack([free * coarse.solve(subdivision.T @ shape) for shape in fine])
        return found, np.stack([subdivision @ shape for shape in found])

    poses = [a for a, _ in states] + list(others)
    given = [np.full_like(rest, np.nan) for _ in poses]
    found, basis = solved(left, right)
    for _ in range(ROUNDS):
        a, b = left.copy(), right.copy()
        for angles, target in zip(poses, given, strict=True):
            place = bones(hand, angles)
            displacement = PoseShapes(features, basis).displacement(angles)
            inside, way = ways_out(skinned(rest + displacement, weights, place), rest, faces)
            turned = np.tensordot(weights[inside], place, 1)[:, :, :3]
            target[inside] = displacement[inside] + np.linalg.solve(turned, way[..., None])[..., 0]
            held = np.flatnonzero(~np.isnan(target[:, 0]))
            x = features(angles) / scale
            a[held] += CONTACT_WEIGHT * np.outer(x, x)
            b[held] += CONTACT_WEIGHT * x[:, None] * target[held][:, None]
        found, basis = solved(a, b)
    return found


def ways_out(surface: Array, rest: Array, faces: Index) -> tuple[Index, Array]:
    """Vertices that lie inside another part of the surface, [n], and half of their ways out [mm], [n, 3]."""
    normals = np.asarray(igl.per_vertex_normals(surface, faces))
    _, near = cKDTree(surface).query(surface, k=NEIGHBOURS, distance_upper_bound=DEEPEST)
    found = near < len(surface)
    near = np.where(found, near, 0)
    opposed = (normals[:, None] * normals[near]).sum(-1) < OPPOSED
    touches = found & opposed & (np.linalg.norm(rest[:, None] - rest[near], axis=-1) > APART)
    vertex = np.flatnonzero(touches.any(1))
    other = near[vertex, touches[vertex].argmax(1)]
    depth = ((surface[other] - surface[vertex]) * normals[other]).sum(-1)
    inside = (depth > -MARGIN) & (depth < DEEPEST)
    return vertex[inside], normals[other[inside]] * ((depth[inside] + MARGIN) / 2)[:, None]


def _within_reach(hand: HandModel) -> np.ndarray:
    """Whether each shape may move each vertex, [V, C]: on its own finger, on those beside it and on the palm."""
    order = {FIRST[finger] + i: place for place, finger in enumerate(FINGERS) for i in range(3)}
    of_joint = np.array([order[joint] for joint in range(1, len(hand.parents))])
    of_vertex = np.array([order.get(joint, -1) for joint in hand.segment.tolist()])
    beside = np.abs(of_vertex[:, None] - of_joint) <= 1
    return np.repeat(beside | (of_vertex < 0)[:, None], 2, axis=1)
