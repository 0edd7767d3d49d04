"""How good a posed surface is: enclosed volume, and edges that cross other faces."""

import numpy as np
import trimesh
from igl.predicates import find_self_intersections

from .anatomy import Array, Index

FLAT = 1e-6
"""Sine-like measure of an edge and a face below which they count as parallel: neighbours in a flat region."""


def closed(vertices: Array, faces: Index, rim: Index) -> tuple[Array, Index]:
    """The surface with its open wrist filled by a fan, wound like the rest."""
    centre = len(vertices)
    fan = np.stack([np.roll(rim, -1), rim, np.full(len(rim), centre)], 1)
    return np.vstack([vertices, vertices[rim].mean(0)]), np.vstack([faces, fan])


def enclosed_volume(vertices: Array, faces: Index, rim: Index) -> float:
    """Volume inside the surface with its wrist closed [m^3]; parts turned inside out count negative."""
    return float(trimesh.Trimesh(*closed(vertices, faces, rim), process=False).volume)


def self_crossings(vertices: Array, faces: Index) -> int:
    """Number of edges that pass through a face they share no corner with (Moller and Trumbore 1997)."""
    pairs = np.asarray(find_self_intersections(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))[1])
    pairs = np.vstack([pairs, pairs[:, ::-1]])
    edges = np.sort(faces[pairs[:, 0]][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    face = np.repeat(pairs[:, 1], 3)
    apart = (faces[face][:, :, None] != edges[:, None, :]).all((1, 2))
    edges, face = edges[apart], face[apart]
    origin = vertices[edges[:, 0]]
    direction = vertices[edges[:, 1]] - origin
    a, b, c = vertices[faces[face]].transpose(1, 0, 2)
    ab, ac = b - a, c - a
    across = np.cross(direction, ac)
    slope = (ab * across).sum(1)
    size = np.linalg.norm(direction, axis=1) * np.linalg.norm(ab, axis=1) * np.linalg.norm(ac, axis=1)
    slope[np.abs(slope) < FLAT * size] = np.nan
    offset = origin - a
    u = (offset * across).sum(1) / slope
    turned = np.cross(offset, ab)
    v = (direction * turned).sum(1) / slope
    place = (ac * turned).sum(1) / slope
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (place >= 0) & (place <= 1)
    return len(np.unique(edges[hit], axis=0))
