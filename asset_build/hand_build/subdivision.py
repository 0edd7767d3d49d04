"""From the 1,598 quads of the base mesh to the HD mesh: one smooth subdivision, then the longest edges are halved.

Everything is kept as linear operators, so that template, shape basis, weights and correctives are carried alike.
"""

import heapq
from typing import Any, NamedTuple

import igl
import numpy as np
import scipy.sparse as sp

from hand_build.anatomy import Array, Index

HD_FACES, HD_RIM = 24_608, 64
"""Faces of the HD mesh and edges of its open rim; with them it has 12,337 vertices, the counts of MANO-HD."""

Sparse = Any  # scipy's sparse types are not generic

Pair = tuple[int, int]


class HdMesh(NamedTuple):
    """The fine mesh, as seen from the base mesh."""

    faces: Index
    uv_faces: Index
    rim: Index
    operator: Sparse
    """Fine vertices from base vertices, [12337, V]; entries are not negative, rows sum to one."""
    uv_operator: Sparse


def _edges(faces: Index) -> tuple[Index, Index, Index]:
    """Edges [E, 2], the edge from each corner of each face to the next, and how many faces each edge has."""
    corners = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2), 1)
    edges, of_face, count = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    return edges, of_face.reshape(faces.shape), count


def _ones(rows: Index, columns: Index, shape: Pair) -> Sparse:
    return sp.coo_matrix((np.ones(rows.size), (rows.ravel(), columns.ravel())), shape).tocsr()


def catmull_clark(quads: Index, n: int, *, smooth: bool) -> tuple[Index, Sparse]:
    """One level of Catmull and Clark 1978: the four times finer quads, and the operator to their vertices.

    New vertices are the old ones, then edge points, then face points. The open rim follows the cubic B-spline rule.
    Without `smooth` all are plain midpoints, which is what texture coordinates need.
    """
    edges, edge_of, count = _edges(quads)
    n_faces, n_edges = len(quads), len(edges)
    face_index = np.repeat(np.arange(n_faces), 4)
    face_point = 0.25 * _ones(face_index, quads, (n_faces, n))
    middle = 0.5 * _ones(np.repeat(np.arange(n_edges), 2), edges, (n_edges, n))
    if smooth:
        inner = (count == 2).astype(float)
        face_of_edge = _ones(edge_of, face_index, (n_edges, n_faces))
        edge_point = sp.diags(1 - 0.5 * inner) @ middle + sp.diags(0.25 * inner) @ (face_of_edge @ face_point)
        at_face = _ones(quads, face_index, (n, n_faces))
        at_edge = _ones(edges, np.repeat(np.arange(n_edges), 2), (n, n_edges))
        valence = np.asarray(at_edge.sum(1)).ravel()
        inside = (
            sp.diags(1 / valence**2) @ (at_face @ face_point)
            + sp.diags(2 / valence**2) @ (at_edge @ middle)
            + sp.diags((valence - 3) / valence)
        )
        rim_edge = at_edge @ sp.diags((count == 1).astype(float))
        n_rim = np.asarray(rim_edge.sum(1)).ravel()
        on_rim = n_rim > 0
        rim = sp.diags(0.5 * on_rim) + sp.diags(0.5 * on_rim / np.maximum(n_rim, 1)) @ (rim_edge @ middle)
        old = sp.diags(1.0 * ~on_rim) @ inside + rim
        operator = sp.vstack([old, edge_point, face_point]).tocsr()
    else:
        operator = sp.vstack([sp.eye(n), middle, face_point]).tocsr()
    edge_vertex, face_vertex = n + edge_of, n + n_edges + np.arange(n_faces)
    corners = [np.stack([quads[:, i], edge_vertex[:, i], face_vertex, edge_vertex[:, i - 1]], 1) for i in range(4)]
    return np.concatenate(corners), operator


def triangulate(vertices: Array, quads: Index, uv_quads: Index) -> tuple[Index, Index]:
    """Triangles, and their texture corners, by the shorter diagonal of each quad."""
    one, other = (np.linalg.norm(vertices[quads[:, a]] - vertices[quads[:, a + 2]], axis=1) for a in (0, 1))
    corners = np.where((one <= other)[:, None], [[0, 1, 2, 0, 2, 3]], [[0, 1, 3, 1, 2, 3]])
    faces, uv_faces = (np.take_along_axis(q, corners, 1).reshape(-1, 3) for q in (quads, uv_quads))
    return faces, uv_faces


def _halve_longest(
    vertices: Array, faces: Index, uv_faces: Index, n_uv: int, *, n_faces: int, rim_splits: int
) -> tuple[Index, Index, list[Pair], list[Pair]]:
    """Halve the longest edge until there are `n_faces`: faces, texture faces, parents of the new vertices of both.

    An inner edge adds two faces and a vertex, a rim edge one face and one vertex; at most `rim_splits` of the latter.
    """
    tri, tri_uv = [list(f) for f in faces], [list(f) for f in uv_faces]
    points = list(vertices)
    at_edge: dict[frozenset, list[int]] = {}
    for t, corners in enumerate(tri):
        for i in range(3):
            at_edge.setdefault(frozenset((corners[i], corners[i - 2])), []).append(t)

    def entry(edge: frozenset) -> tuple[float, list[int]]:
        return -float(np.linalg.norm(points[min(edge)] - points[max(edge)])), sorted(edge)

    heap = [entry(edge) for edge in at_edge]
    heapq.heapify(heap)
    parents: list[Pair] = []
    uv_parents: list[Pair] = []
    while len(tri) < n_faces:
        _, (a, b) = heapq.heappop(heap)
        edge = frozenset((a, b))
        if len(at_edge[edge]) == 1:
            if rim_splits == 0:
                continue
            rim_splits -= 1
        neighbours, middle = at_edge.pop(edge), len(points)
        points.append((points[a] + points[b]) / 2)
        parents.append((a, b))
        uv_middle: dict[frozenset, int] = {}  # two on a seam, where the faces do not share texture corners
        for t in neighbours:
            first = next(i for i in range(3) if tri[t][i] not in edge)
            apex, left, right = (tri[t][(first + s) % 3] for s in range(3))
            apex_uv, left_uv, right_uv = (tri_uv[t][(first + s) % 3] for s in range(3))
            uv_edge = frozenset((left_uv, right_uv))
            if uv_edge not in uv_middle:
                uv_middle[uv_edge] = n_uv
                uv_parents.append((left_uv, right_uv))
                n_uv += 1
            new = len(tri)
            tri[t], tri_uv[t] = [apex, left, middle], [apex_uv, left_uv, uv_middle[uv_edge]]
            tri.append([apex, middle, right])
            tri_uv.append([apex_uv, uv_middle[uv_edge], right_uv])
            moved = at_edge[frozenset((apex, right))]
            moved[moved.index(t)] = new
            for pair, owners in (((apex, middle), [t, new]), ((left, middle), [t]), ((middle, right), [new])):
                at_edge.setdefault(frozenset(pair), []).extend(owners)
        for corner in {c for t in neighbours for c in tri[t] if c != middle} | {a, b}:
            heapq.heappush(heap, entry(frozenset((corner, middle))))
    return np.array(tri), np.array(tri_uv), parents, uv_parents


def _with_middles(operator: Sparse, parents: list[Pair], known: dict[Pair, Any]) -> Sparse:
    """`operator` with a row for each pair of parents: the known one, else the mean of the parents' rows."""
    rows = [operator.getrow(i) for i in range(operator.shape[0])]
    for a, b in parents:
        row = known.get((min(a, b), max(a, b)))
        rows.append((rows[a] + rows[b]) * 0.5 if row is None else row)
    return sp.vstack(rows).tocsr()


def hd_mesh(vertices: Array, quads: Index, uv: Array, uv_quads: Index) -> HdMesh:
    """The mesh of 12,337 vertices and 24,608 faces over the base mesh `vertices` [V, 3].

    New vertices that the second level of Catmull-Clark also has take their place from it: plain midpoints would show
    as dots on the palm.
    """
    fine_quads, first = catmull_clark(quads, len(vertices), smooth=True)
    fine_uv_quads, uv_first = catmull_clark(uv_quads, len(uv), smooth=False)
    fine = first @ vertices
    faces, uv_faces = triangulate(fine, fine_quads, fine_uv_quads)
    rim_edges = len(igl.boundary_loop(faces))
    faces, uv_faces, parents, uv_parents = _halve_longest(
        fine, faces, uv_faces, uv_first.shape[0], n_faces=HD_FACES, rim_splits=HD_RIM - rim_edges
    )
    n = first.shape[0]
    second = (catmull_clark(fine_quads, n, smooth=True)[1] @ first).tocsr()
    edges, _, _ = _edges(fine_quads)
    known = {(int(a), int(b)): n + i for i, (a, b) in enumerate(edges)}
    for i, (a, b, c, d) in enumerate(fine_quads):
        for pair in (sorted((a, c)), sorted((b, d))):
            known.setdefault((int(pair[0]), int(pair[1])), n + len(edges) + i)
    wanted = {(int(min(pair)), int(max(pair))) for pair in parents}
    rows = {pair: second.getrow(row) for pair, row in known.items() if pair in wanted}
    return HdMesh(
        faces=faces,
        uv_faces=uv_faces,
        rim=igl.boundary_loop(faces),
        operator=_with_middles(second[:n], parents, rows),
        uv_operator=_with_middles(uv_first, uv_parents, {}),
    )
