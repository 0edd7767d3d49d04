"""A thin elastic surface: as rigid as possible where it is free, held where bones hold it, kept out of planes."""

from typing import NamedTuple

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from hand_build.anatomy import Array, Index

SMALLEST_COTANGENT = 0.01
"""Edge weights are cotangents, clamped: obtuse corners would push instead of pull."""
CONTACT_STIFFNESS = 30.0
"""Of a vertex pressed against a plane, in units of cotangents: ten times an edge, so contact wins over shape."""
CONTACT_GAP = 5e-4
"""Distance that contact leaves to its plane, so that the two sides of a fold do not touch [m]."""


class Fold(NamedTuple):
    """Contact of the two sides of a crease: each stays on its own side of the plane that halves the bend."""

    point: Array
    normal: Array
    side: Array
    """+1 or -1 for each vertex, [V]; 0 where the plane does not count."""
    inward: Array
    """Direction from the bone to the crease; there is no contact behind the bone."""
    depth: float
    """How far along `inward` from `point` contact begins [m]."""

    def penetration(self, at: Array) -> Array:
        """How far each vertex has to go back along its side of the normal [m], 0 where it is right."""
        offset = at - self.point
        missing = CONTACT_GAP - (offset @ self.normal) * self.side
        return np.where((self.side != 0) & (offset @ self.inward > self.depth), np.maximum(missing, 0), 0)


class ElasticSurface:
    """A closed surface that remembers its rest shape."""

    def __init__(self, vertices: Array, faces: Index) -> None:
        n = len(vertices)
        cotangents = igl.cotmatrix(vertices, faces).tocoo()
        off = cotangents.row != cotangents.col
        self._a, self._b = cotangents.row[off], cotangents.col[off]
        self._stiffness = np.maximum(cotangents.data[off], SMALLEST_COTANGENT)
        self._edges = vertices[self._a] - vertices[self._b]
        self._laplacian = sp.diags(np.bincount(self._a, self._stiffness, n)) - sp.coo_matrix(
            (self._stiffness, (self._a, self._b)), (n, n)
        )
        self.faces = faces

    def volume_gradient(self, at: Array) -> Array:
        """Change of the enclosed volume with each vertex [m^2]; its product with `at`, over 3, is the volume [m^3]."""
        gradient = np.zeros_like(at)
        corners = at[self.faces]
        for i in range(3):
            np.add.at(gradient, self.faces[:, i], np.cross(corners[:, i - 2], corners[:, i - 1]) / 6)
        return gradient

    def volume(self, at: Array) -> float:
        """Signed volume inside [m^3]."""
        return float((self.volume_gradient(at) * at).sum() / 3)

    def relax(
        self, start: Array, hold: Array, *, fold: Fold | None = None, swell: Array | None = None, volume: float = 0.0,
        steps: int = 25,
    ) -> Array:  # fmt: skip
        """Where the surface settles: as rigid as possible (Sorkine and Alexa 2007), each vertex pulled to `start`.

        Args:
            start: Places that the vertices begin at and are pulled to [m], [V, 3].
            hold: Stiffness of that pull in units of cotangents, [V].
            fold: A crease whose sides press against each other.
            swell: Where the surface gives way, in 0 to 1, [V], while it is blown up to at least `volume` [m^3].
            volume: See `swell`.
            steps: Rounds of finding rotations, then places.
        """
        at = start
        n = len(start)
        for _ in range(steps):
            rotation = self._rotations(at)
            pull = self._stiffness[:, None] * _apply(rotation[self._a] + rotation[self._b], self._edges) / 2
            right = hold[:, None] * start
            np.add.at(right, self._a, pull)
            pressed = np.zeros(n)
            if fold is not None:
                back = fold.penetration(at)
                pressed[back > 0] = CONTACT_STIFFNESS
                right += pressed[:, None] * (at + (back * fold.side)[:, None] * fold.normal)
            matrix = (self._laplacian + sp.diags(hold + pressed)).tocsc()
            at = scipy.sparse.linalg.spsolve(matrix, right)
            if swell is not None:
                gradient = self.volume_gradient(at)
                missing = max(volume - float((gradient * at).sum() / 3), 0.0)
                at = at + swell[:, None] * gradient * (missing / (swell[:, None] * gradient**2).sum())
        if fold is not None:
            at = at + (fold.penetration(at) * fold.side)[:, None] * fold.normal
        return at

    def _rotations(self, at: Array) -> Array:
        """The rotation of each vertex's edges since rest, [V, 3, 3] (Kabsch)."""
        spread = np.zeros((len(at), 3, 3))
        now = at[self._a] - at[self._b]
        np.add.at(spread, self._a, self._stiffness[:, None, None] * self._edges[:, :, None] * now[:, None, :])
        u, _, vt = np.linalg.svd(spread)
        vt[np.linalg.det(u @ vt) < 0, 2] *= -1
        return (u @ vt).transpose(0, 2, 1)


def _apply(matrices: Array, vectors: Array) -> Array:
    return (matrices @ vectors[..., None])[..., 0]
