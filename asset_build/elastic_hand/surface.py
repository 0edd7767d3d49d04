"""From the nodes on the skin of a posed solid to all vertices of the hand."""

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from hand_build.anatomy import Array

from elastic_hand.solid import MILLIMETRES, Solid
from oasis_warp.core.hand_model import HandModel

FIRMNESS = 1e-3
"""Of the mean against the bent Laplacian: keeps the system definite."""


class SkinMap:
    """Displacements of the rest surface that blend skinning carries to where the flesh is.

    At the nodes they are exact; in between they are the smoothest ones (least square of the Laplacian).
    """

    def __init__(self, hand: HandModel, solid: Solid) -> None:
        self.rest = hand.template.double().numpy() * MILLIMETRES
        self.weights = hand.weights.double().numpy()
        self.vertex = solid.vertex
        self._others = np.setdiff1d(np.arange(len(self.rest)), solid.vertex)
        faces = hand.faces.numpy()
        laplacian = igl.cotmatrix(self.rest, faces)
        mass = sp.diags(1 / igl.massmatrix(self.rest, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal())
        bending = (laplacian.T @ mass @ laplacian).tocsr()
        self._known = bending[self._others][:, solid.vertex]
        inner = bending[self._others][:, self._others] + FIRMNESS * sp.eye(len(self._others))
        self._factor = scipy.sparse.linalg.splu(inner.tocsc(), permc_spec="MMD_AT_PLUS_A")

    def displacements(self, nodes: Array, bones: Array) -> Array:
        """Of the rest surface [mm], [V, 3], for posed nodes [mm] on bones [16, 3, 4]."""
        blend = np.tensordot(self.weights[self.vertex], bones, 1)
        offset = nodes[: len(self.vertex)] - blend[:, :, 3]
        found = np.zeros_like(self.rest)
        found[self.vertex] = np.linalg.solve(blend[:, :, :3], offset[..., None])[..., 0] - self.rest[self.vertex]
        found[self._others] = -self._factor.solve(self._known @ found[self.vertex])
        return found

    def surface(self, nodes: Array, bones: Array) -> Array:
        """Posed vertices of the hand [mm], [V, 3]."""
        return skinned(self.rest + self.displacements(nodes, bones), self.weights, bones)


def skinned(points: Array, weights: Array, bones: Array) -> Array:
    """Linear blend skinning of rest points."""
    blend = np.tensordot(weights, bones, 1)
    return (blend[:, :, :3] @ points[..., None])[..., 0] + blend[:, :, 3]
