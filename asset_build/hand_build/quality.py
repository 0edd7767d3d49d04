"""How good a posed surface is: enclosed volume, edges that cross other faces, girth of a section."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from hand_build.anatomy import Array, Index

FLAT = 1e-6
"""Sine-like measure of an edge and a face below which they count as parallel: neighbours in a flat region."""


def closed(vertices: Array, faces: Index, rim: Index) -> tuple[Array, Index]:
    """The surface with its open wrist filled by a fan, wound like the rest."""
    centre = len(vertices)
    fan = np.stack([np.roll(rim, -1), rim, np.full(len(rim), centre)], 1)
    return np.vstack([vertices, vertices[rim].mean(0)]), np.vstack([faces, fan])


def signed_volume(vertices: Array, faces: Index) -> float:
    """Volume inside a closed surface [m^3]; parts turned inside out count negative."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def self_crossings(vertices: Array, faces: Index) -> int:
    """Number of edges that pass through a face they share no corner with (Moller and Trumbore 1997)."""
    corners = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(corners, 1), axis=0)
    start, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    centres = vertices[faces].mean(1)
    face_radius = np.linalg.norm(vertices[faces] - centres[:, None], axis=2).max()
    reach = np.linalg.norm(along, axis=1) / 2 + face_radius
    near = cKDTree(centres).query_ball_point(start + along / 2, reach)
    edge = np.repeat(np.arange(len(edges)), [len(found) for found in near])
    face = np.concatenate([np.asarray(found, int) for found in near])
    apart = (faces[face][:, :, None] != edges[edge][:, None, :]).all((1, 2))
    edge, face = edge[apart], face[apart]
    origin, way = start[edge], along[edge]
    a, b, c = vertices[faces[face]].transpose(1, 0, 2)
    ab, ac = b - a, c - a
    across = np.cross(way, ac)
    slope = (ab * across).sum(1)
    size = np.linalg.norm(way, axis=1) * np.linalg.norm(ab, axis=1) * np.linalg.norm(ac, axis=1)
    slope[np.abs(slope) < FLAT * size] = np.nan
    offset = origin - a
    u = (offset * across).sum(1) / slope
    turned = np.cross(offset, ab)
    v = (way * turned).sum(1) / slope
    place = (ac * turned).sum(1) / slope
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (place >= 0) & (place <= 1)
    return len(np.unique(edge[hit]))


def section_girth(vertices: Array, faces: Index, point: Array, normal: Array) -> float:
    """Length [m] of the closed curve around `point` in which a plane cuts the surface."""
    section = trimesh.Trimesh(vertices, faces, process=False).section(plane_normal=normal, plane_origin=point)
    assert section is not None, "the plane goes through a joint, inside the surface"
    loops = [loop for loop in section.discrete if np.allclose(loop[0], loop[-1])]
    nearest = min(loops, key=lambda loop: float(np.linalg.norm(loop.mean(0) - point)))
    return float(np.linalg.norm(np.diff(nearest, axis=0), axis=1).sum())
