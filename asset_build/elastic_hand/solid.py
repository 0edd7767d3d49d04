"""The bundled hand as tetrahedra with bones, and the way back from their nodes to the vertices of the hand."""

from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
import torch
from hand_build.anatomy import FINGERS, FIRST, Array, Index, bone_ends
from hand_build.quality import closed
from scipy.spatial import Delaunay, cKDTree

from oasis_warp.core.hand_model import HandModel

MILLIMETRES = 1e3
SURFACE_SPACING, PALM_SPACING, FINGER_SPACING = 2.8, 6.0, 3.7
"""Least distance of nodes on the skin, and edges of the body-centred lattices under it [mm]."""
BRIDGE, LONGEST = 0.4, 9.0
"""An edge further outside the hand, or longer, is no flesh [mm]."""
LATTICE_DEPTH = 1.6
"""How far under the skin the lattice begins [mm]."""
THINNEST = 2e-3
"""Tetrahedra below this quality (1 for a regular one) hold nothing: left out."""
BONE_SHARE = 0.42
"""Radius of a bone, as a share of the least distance from its axis to the skin."""
PALM_BONE_RADIUS = 4.0
BONE_START = 1.3
"""How far from its joint a bone begins, in radii: the head of the bone before it lies there."""
WRIST_DEPTH = 6.0
"""How far from the wrist's rim everything is held [mm]."""
FIRMNESS = 1e-3
"""Of the mean against the bent Laplacian: keeps the system definite."""


NEIGHBOURS = 24
"""Points among which skin looks for other skin that it faces."""


@dataclass(frozen=True)
class Solid:
    """Nodes [mm] and tetrahedra of the hand at rest."""

    nodes: Array
    """[N, 3]; skin first."""
    tetrahedra: Index
    """[T, 4], positively oriented."""
    skin: Index
    """Outer faces, wound like the hand's, [S, 3]."""
    bone: Index
    """Joint whose bone each node is part of, -1 in flesh, [N]."""
    vertex: Index
    """Vertex of the hand that each of the first nodes is, [M]."""


def fill(hand: HandModel) -> Solid:
    """The mean hand at rest as a solid."""
    vertices = hand.template.double().numpy() * MILLIMETRES
    shell, faces = closed(vertices, hand.faces.numpy(), hand.rim.numpy())
    chosen = _thinned(vertices, SURFACE_SPACING)
    nodes = np.vstack([vertices[chosen], _lattice(hand, shell, faces)])
    tetrahedra = Delaunay(nodes).simplices.astype(np.int64)
    tetrahedra = tetrahedra[_inside(shell, faces, nodes[tetrahedra].mean(1))]
    edges = [(a, b) for a in range(4) for b in range(a)]
    tree = igl.AABB()
    tree.init(shell, faces)
    for a, b in edges:
        start, end = nodes[tetrahedra[:, a]], nodes[tetrahedra[:, b]]
        middle = (start + end) / 2
        outside = ~_inside(shell, faces, middle)
        outside[outside] = np.asarray(tree.squared_distance(shell, faces, middle[outside])[0]) > BRIDGE**2
        tetrahedra = tetrahedra[~outside & (np.linalg.norm(end - start, axis=1) < LONGEST)]
    six = _six_volumes(nodes[tetrahedra])
    tetrahedra[six < 0] = tetrahedra[six < 0][:, [1, 0, 2, 3]]
    length = np.sqrt(sum(((nodes[tetrahedra[:, a]] - nodes[tetrahedra[:, b]]) ** 2).sum(1) for a, b in edges) / 6)
    tetrahedra = tetrahedra[np.abs(six) * np.sqrt(2) > THINNEST * length**3]
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    nodes, tetrahedra = nodes[used], renumbered.reshape(-1, 4)
    return Solid(
        nodes, tetrahedra, outer_faces(tetrahedra), _bones(hand, nodes), chosen[used[used < len(chosen)]]
    )


def _inside(shell: Array, faces: Index, points: Array) -> np.ndarray:
    """Whether each point is inside the closed surface, [N]."""
    return np.asarray(igl.fast_winding_number(shell, faces, points)) > 0.5


def _six_volumes(corners: Array) -> Array:
    return np.linalg.det(corners[:, 1:] - corners[:, :1])


def _thinned(points: Array, spacing: float) -> Index:
    """Points no two of which are closer than `spacing`, first come, first served."""
    near = cKDTree(points).query_ball_point(points, spacing)
    free = np.ones(len(points), bool)
    for index in range(len(points)):
        if free[index]:
            free[near[index]] = False
            free[index] = True
    return np.flatnonzero(free)


def _lattice(hand: HandModel, shell: Array, faces: Index) -> Array:
    """Body-centred lattices inside the skin, finer in the fingers."""
    in_finger = hand.segment.numpy() > 0
    tree = cKDTree(hand.template.double().numpy() * MILLIMETRES)
    kept = []
    for spacing, of_finger in ((PALM_SPACING, False), (FINGER_SPACING, True)):
        axes = [np.arange(low, high, spacing) for low, high in zip(shell.min(0), shell.max(0), strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        points = np.vstack([grid, grid + spacing / 2])
        points = points + np.random.default_rng(0).uniform(-0.1, 0.1, points.shape)  # no five on a sphere
        points = points[_inside(shell, faces, points)]
        distance, nearest = tree.query(points)
        kept.append(points[(distance > LATTICE_DEPTH) & (in_finger[nearest] == of_finger)])
    return np.vstack(kept)


def outer_faces(tetrahedra: Index) -> Index:
    """Faces of one tetrahedron only, seen from outside against the clock."""
    faces = np.vstack([tetrahedra[:, corners] for corners in ([1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1])])
    _, first, count = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def _bones(hand: HandModel, nodes: Array) -> Index:
    points = torch.cat([hand.joints, hand.tips]).double().numpy() * MILLIMETRES
    shell = hand.template.double().numpy() * MILLIMETRES
    ends = bone_ends(points)
    skin_tree = cKDTree(shell)
    bone = np.full(len(nodes), -1)

    def cover(joint: int, start: Array, end: Array, radius: float) -> None:
        along = end - start
        at = np.clip((nodes - start) @ along / (along @ along), 0, 1)
        bone[np.linalg.norm(nodes - start - at[:, None] * along, axis=1) < radius] = joint

    for joint in range(15, 0, -1):  # heads of bones last, over the bases of the next
        start, end = points[joint], ends[joint]
        along = (end - start) / np.linalg.norm(end - start)
        axis = start + np.linspace(0.25, 0.75, 5)[:, None] * (end - start)
        radius = BONE_SHARE * skin_tree.query(axis)[0].min()
        last = joint in {FIRST[f] + 2 for f in FINGERS}
        cover(joint, start + BONE_START * radius * along, end - (2.5 * radius * along if last else 0), radius)
    for finger in FINGERS:
        cover(0, points[0], points[FIRST[finger]], PALM_BONE_RADIUS)
    bone[nodes[:, 0] > shell[:, 0].max() - WRIST_DEPTH] = 0
    nails = cKDTree(shell[hand.nail.numpy() > 0.5])
    ends_of_fingers = np.array([FIRST[f] + 2 for f in FINGERS])
    tips = points[[16 + FINGERS.index(f) for f in FINGERS]]
    nail_nodes = np.flatnonzero(nails.query(nodes)[0] < 0.1)
    bone[nail_nodes] = ends_of_fingers[cKDTree(tips).query(nodes[nail_nodes])[1]]
    assert np.isin(np.arange(16), bone).all(), "every bone holds nodes"
    return bone


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


def facing_skin(
    points: Array, normals: Array, rest: Array, *, reach: float, cosine: float, apart: float
) -> tuple[Index, Index]:
    """Points of the skin that face other skin within `reach`, and the nearest point that each of them faces, [n] each.

    Their normals have at most that cosine, and at rest they are at least so far apart.
    """
    _, near = cKDTree(points).query(points, NEIGHBOURS, distance_upper_bound=reach)
    found = near < len(points)
    near = np.where(found, near, 0)
    opposed = (normals[:, None] * normals[near]).sum(-1) < cosine
    facing = found & opposed & (np.linalg.norm(rest[:, None] - rest[near], axis=-1) > apart)
    index = np.flatnonzero(facing.any(1))
    return index, near[index, facing[index].argmax(1)]


def skinned(points: Array, weights: Array, bones: Array) -> Array:
    """Linear blend skinning of rest points."""
    blend = np.tensordot(weights, bones, 1)
    return (blend[:, :, :3] @ points[..., None])[..., 0] + blend[:, :, 3]
