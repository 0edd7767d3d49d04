"""Ways to skin a hand that are cheaper than flesh: dual quaternions, delta mush, fitted pose shapes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from hand_build.anatomy import FIRST, Array, Index
from scipy.spatial.transform import Rotation

from elastic_hand.surface import skinned
from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.correctives import corrective_coefficients

RIDGES = (1e-3, 1e-2, 1e-1, 1.0)
FOLDS = 4
Features = Callable[[Array], Array]
"""Joint angles [15, 3] to strengths [C]."""


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
        n = len(rest)
        edges = np.concatenate([faces[:, [a, (a + 1) % 3]] for a in range(3)])
        edges = np.concatenate([edges, edges[:, ::-1]])
        near = sp.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (n, n))
        near.data[:] = 1
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
        corners = surface[self.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = np.stack([np.bincount(self.faces.ravel(), np.repeat(across[:, k], 3)) for k in range(3)], 1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
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


def posed(rest: Array, displacement: Array, weights: Array, bones: Array) -> Array:
    """Blend skinning of the displaced rest surface."""
    return skinned(rest + displacement, weights, bones)
