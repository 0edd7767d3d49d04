"""Flesh on posed bones: the nodes of a solid that minimise an elastic energy, with contact between its parts.

Energy of a tetrahedron: volume x (mu |F - R|^2 + lambda / 2 (det F - 1)^2), F its deformation, R the rotation nearest
to F (fixed corotated elasticity, Stomakhin et al. 2012). Skin in other skin is pushed out by a quadratic penalty.
L-BFGS from the stiffness of the rest state (Liu, Bouaziz and Kavan 2017), bones bent in small steps.
"""

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from hand_build.anatomy import Array, Index

from elastic_hand.solid import Solid, facing_skin

MU = 1.0
LAMBDA = 9.0
"""Times mu: Poisson's ratio 0.45."""
CONTACT = 10.0
"""Pressure of skin per depth that it has entered other skin, in mu / mm."""
CONTACT_GAP = 0.5
CONTACT_REACH = 6.0
CONTACT_APART = 6.0
"""Skin meets other skin within this reach that is at least so far away at rest [mm]."""
CONTACT_DEPTH = 3.0
"""Skin further below other skin is the far side of something thin [mm]."""
MEMORY = 8
BLOCK = 2048
"""Tetrahedra at a time: their numbers stay in the cache."""
FLAT = 0.02
"""Determinant below which a deformation's rotation is found by svd."""
ROUNDS, STEPS = 4, 12
"""Of finding what touches, and of descent between them."""
SETTLED = 2e-5
"""A descent ends when its next step promises a smaller share of the energy."""


@dataclass(frozen=True)
class Contacts:
    """Nodes that have entered the skin around others."""

    node: Index
    other: Index
    normal: Array
    area: Array


class Flesh:
    """A solid with its stiffness factorised."""

    def __init__(self, solid: Solid) -> None:
        self.solid = solid
        corners = solid.nodes[solid.tetrahedra]
        frame = (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2)
        inverse = np.linalg.inv(frame)
        gradient = np.concatenate([-inverse.sum(1, keepdims=True), inverse], 1)
        self._inverse = np.ascontiguousarray(inverse.transpose(1, 2, 0), np.float32)
        self.volume = np.linalg.det(frame) / 6
        """Of each tetrahedron at rest [mm^3], [T]."""
        n, t = len(solid.nodes), len(solid.tetrahedra)
        self._scatter = sp.csr_matrix((np.ones(4 * t), (solid.tetrahedra.T.ravel(), np.arange(4 * t))), (n, 4 * t))
        stiffness = self.volume[:, None, None] * (gradient @ gradient.swapaxes(1, 2))
        pairs = np.repeat(solid.tetrahedra, 4, 1).ravel(), np.tile(solid.tetrahedra, (1, 4)).ravel()
        laplacian = sp.csr_matrix((stiffness.ravel(), pairs), (n, n))
        self.free = np.flatnonzero(solid.bone < 0)
        self.held = np.flatnonzero(solid.bone >= 0)
        self._factor = scipy.sparse.linalg.splu(
            laplacian[self.free][:, self.free].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
        share = np.eye(16)[solid.bone[self.held]]
        self.weights = np.zeros((n, 16))
        """Harmonic share of each bone in each node: only where a step of bending starts from."""
        self.weights[self.held] = share
        self.weights[self.free] = -self._factor.solve(np.asarray(laplacian[self.free][:, self.held] @ share))
        self._skin_nodes = np.unique(solid.skin)

    def swelling(self, at: Array) -> Array:
        """Volume of each tetrahedron over its volume at rest, [T]; negative where it is turned inside out."""
        return _determinant(self._deformation(at, slice(None)))

    def _deformation(self, at: Array, part: slice) -> Array:
        """F of tetrahedra, [3, 3, T]."""
        corners = at.T[:, self.solid.tetrahedra[part].T]
        edges = (corners[:, 1:] - corners[:, :1]).astype(np.float32)
        inverse = self._inverse[:, :, part]
        return edges[:, 0, None] * inverse[0] + edges[:, 1, None] * inverse[1] + edges[:, 2, None] * inverse[2]

    def bend(self, at: Array, before: Array, after: Array) -> Array:
        """Nodes once the bones [16, 3, 4] have moved from `before` to `after`, nodes before them being `at`."""
        rotation = after[:, :, :3] @ before[:, :, :3].swapaxes(1, 2)
        shift = after[:, :, 3] - (rotation @ before[:, :, 3:])[..., 0]
        blend = np.tensordot(self.weights, np.concatenate([rotation, shift[..., None]], 2), 1)
        start = (blend[:, :, :3] @ at[..., None])[..., 0] + blend[:, :, 3]
        rest, own = self.solid.nodes[self.held], self.solid.bone[self.held]
        start[self.held] = (after[own, :, :3] @ rest[..., None])[..., 0] + after[own, :, 3]
        return self.relax(start)

    def relax(self, at: Array) -> Array:
        """Let the flesh settle; bones stay."""
        for _ in range(ROUNDS):
            contacts = self.contacts(at)
            at, settled = self._descend(at, contacts)
            if settled and not len(contacts.node):
                break
        return at

    def contacts(self, at: Array) -> Contacts:
        """Skin nodes close to, or inside, skin that faces them."""
        nodes = self._skin_nodes
        skin = self.solid.skin
        normals = np.asarray(igl.per_vertex_normals(at, skin, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA))
        areas = np.bincount(skin.ravel(), np.repeat(np.asarray(igl.doublearea(at, skin)) / 6, 3), len(at))
        node, other = nodes[np.stack(facing_skin(
            at[nodes], normals[nodes], self.solid.nodes[nodes], reach=CONTACT_REACH, cosine=-0.2, apart=CONTACT_APART
        ))]  # fmt: skip
        normal = normals[other]
        height = ((at[node] - at[other]) * normal).sum(1)
        close = (height > -CONTACT_DEPTH) & (height < CONTACT_GAP + 1)
        return Contacts(node[close], other[close], normal[close], areas[node[close]])

    def energy(self, at: Array, contacts: Contacts) -> tuple[float, Array]:
        """Of the flesh, and its gradient by the nodes."""
        value = 0.0
        forces = np.empty((4, len(self.volume), 3))
        for first in range(0, len(self.volume), BLOCK):
            part = slice(first, first + BLOCK)
            deformation, volume = self._deformation(at, part), self.volume[part].astype(np.float32)
            strain = deformation - nearest_rotations(deformation)
            cofactor = _cofactor(deformation)
            swell = (deformation[0] * cofactor[0]).sum(0) - 1
            value += float(volume @ (MU * (strain**2).sum((0, 1)) + LAMBDA / 2 * swell**2))
            stress = volume * (2 * MU * strain + LAMBDA * swell * cofactor)
            inverse = self._inverse[:, :, part]
            by_corner = sum(stress[:, None, j] * inverse[None, :, j] for j in range(3))
            forces[1:, part] = by_corner.transpose(1, 2, 0)
            forces[0, part] = -by_corner.sum(1).T
        gradient = self._scatter @ forces.reshape(-1, 3)
        height = ((at[contacts.node] - at[contacts.other]) * contacts.normal).sum(1)
        depth = np.maximum(CONTACT_GAP - height, 0)
        value += float(CONTACT / 2 * (contacts.area * depth**2).sum())
        push = (CONTACT * contacts.area * depth)[:, None] * contacts.normal
        np.add.at(gradient, contacts.node, -push)
        np.add.at(gradient, contacts.other, push)
        return value, gradient

    def _descend(self, at: Array, contacts: Contacts) -> tuple[Array, bool]:
        """Some steps of L-BFGS, and whether fewer were enough."""
        value, gradient = self.energy(at, contacts)
        moves: list[tuple[Array, Array]] = []
        for _ in range(STEPS):
            direction = self._downhill(gradient[self.free], moves)
            slope = float((gradient[self.free] * direction).sum())
            if -slope < SETTLED * value:
                return at, True
            step = 1.0
            while True:
                trial = at.copy()
                trial[self.free] += step * direction
                new_value, new_gradient = self.energy(trial, contacts)
                if new_value <= value + 1e-4 * step * slope or step < 1e-3:
                    break
                step /= 2
            moves.append((step * direction, (new_gradient - gradient)[self.free]))
            moves = moves[-MEMORY:]
            at, value, gradient = trial, new_value, new_gradient
        return at, False

    def _downhill(self, gradient: Array, moves: list[tuple[Array, Array]]) -> Array:
        """The two loops of L-BFGS."""
        q = gradient.copy()
        kept = []
        for s, y in reversed(moves):
            curvature = float((s * y).sum())
            if curvature > 0:
                factor = float((s * q).sum()) / curvature
                q -= factor * y
                kept.append((s, y, curvature, factor))
        direction = self._factor.solve(q) / (2 * MU + LAMBDA / 3)
        for s, y, curvature, factor in reversed(kept):
            direction += s * (factor - float((y * direction).sum()) / curvature)
        return -direction


def nearest_rotations(matrices: Array) -> Array:
    """The rotation nearest to each matrix, [3, 3, T]: Newton's iteration (Higham 1986), by svd where one is flat."""
    flat = np.flatnonzero(_determinant(matrices) < FLAT)
    found = matrices.copy()
    found[:, :, flat] = np.eye(3, dtype=np.float32)[:, :, None]
    for _ in range(20):
        cofactor = _cofactor(found)
        inverse = cofactor / (found[0] * cofactor[0]).sum(0)
        scale = np.sqrt(np.sqrt((inverse**2).sum((0, 1)) / (found**2).sum((0, 1))))
        last, found = found, (scale * found + inverse / scale) / 2
        if np.abs(found - last).max() < 1e-3:  # the iteration doubles the digits
            break
    if len(flat):
        u, _, vt = np.linalg.svd(matrices[:, :, flat].transpose(2, 0, 1))
        u[np.linalg.det(u @ vt) < 0, :, 2] *= -1
        found[:, :, flat] = (u @ vt).transpose(1, 2, 0)
    return found


def _cofactor(matrices: Array) -> Array:
    """[3, 3, T]."""
    out = np.empty_like(matrices)
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (j + 1) % 3, (i + 2) % 3, (j + 2) % 3
            out[i, j] = matrices[a, b] * matrices[c, d] - matrices[a, d] * matrices[c, b]
    return out


def _determinant(matrices: Array) -> Array:
    return (matrices[0] * _cofactor(matrices)[0]).sum(0)
