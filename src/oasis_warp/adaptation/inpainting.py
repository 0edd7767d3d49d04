"""Surface inpainting: observed values fade smoothly into the prior around the region that photos show."""

import functools

import numpy as np
import scipy.sparse as sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core.sparse_factors import factorized, sparse_order

DETAIL_LENGTH = 0.001
"""Length below which differences between neighbouring observations are averaged [m]."""
FADE_LENGTH = 0.012
"""Distance over which the surface forgets the photo and returns to the prior [m]."""
DEGENERATE = 1e-12
"""Doubled area of a triangle below which its angles mean nothing [m^2]: the hand's are over 100,000 times that."""


def inpaint(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    observed: Float[Tensor, "V D"],
    confidence: Float[Tensor, "V"],
    detail: float = DETAIL_LENGTH,
    fade: float = FADE_LENGTH,
) -> Float[Tensor, "V D"]:
    """The smooth field that follows `observed` where it is known and fades to zero along the surface elsewhere.

    Minimises the integral over the surface of confidence |x - observed|^2 / detail^2 + |grad x|^2 + |x|^2 / fade^2,
    the screened Poisson equation (M (c / d^2 + 1 / l^2) + L) x = M c / d^2 observed, with the cotangent Laplacian L and
    the lumped mass matrix M.

    Args:
        vertices: Vertices of the surface [m].
        faces: Corners.
        observed: Values; those without confidence do not matter.
        confidence: 0 to 1.
        detail: Length d below which neighbouring observations are averaged [m].
        fade: Length l over which the surface forgets them [m].
    """
    points = vertices.detach().cpu().numpy().astype(np.float64)
    triangles = faces.detach().cpu().numpy().astype(np.int64)
    laplacian, mass, order = _ordered(points.tobytes(), triangles.tobytes())
    data = mass * confidence.detach().cpu().numpy().astype(np.float64) / detail**2
    system = laplacian + sparse.diags((data + mass / fade**2)[order])
    right = data[:, None] * observed.detach().cpu().numpy().astype(np.float64)
    solution = np.empty_like(right)
    solution[order] = factorized(system).solve(np.ascontiguousarray(right[order]))
    return torch.from_numpy(solution).to(observed)


@functools.lru_cache(2)
def _ordered(points: bytes, triangles: bytes) -> tuple[sparse.csc_array, np.ndarray, np.ndarray]:
    """`laplacian_and_mass`, the Laplacian in an order of vertices that makes factors sparse, and that order.

    One photo fills several fields over one surface.
    """
    corners = np.frombuffer(triangles, np.int64).reshape(-1, 3)
    laplacian, mass = laplacian_and_mass(np.frombuffer(points).reshape(-1, 3), corners)
    order = _order(triangles, len(mass))
    return laplacian[order][:, order].tocsc(), mass, order


@functools.lru_cache(1)
def _order(triangles: bytes, n: int) -> np.ndarray:
    """Of vertices, by triangles alone: one serves every photo."""
    corners = np.frombuffer(triangles, np.int64).reshape(-1, 3)
    ends = corners.ravel(), np.roll(corners, 1, 1).ravel()
    beside = sparse.coo_array((np.ones(corners.size), ends), shape=(n, n))
    return sparse_order(beside + beside.T + corners.size * sparse.eye_array(n))


def laplacian_and_mass(points: np.ndarray, triangles: np.ndarray) -> tuple[sparse.csc_array, np.ndarray]:
    """The cotangent Laplacian, positive semi-definite, [V, V], and a third of the area round each vertex, [V].

    An edge weighs half the sum of the cotangents of the angles opposite to it (Pinkall and Polthier 1993). libigl's
    `cotmatrix` gives the same and is as fast, but importing it takes half a second of every reconstruction, and a
    degenerate triangle fills its matrix with NaN.
    """
    n = len(points)
    corners = points[triangles]
    arms = corners[:, [1, 2, 0]] - corners, corners[:, [2, 0, 1]] - corners
    double_area = np.linalg.norm(np.cross(arms[0][:, 0], arms[1][:, 0]), axis=-1)
    cotangents = (arms[0] * arms[1]).sum(-1) / np.maximum(double_area, DEGENERATE)[:, None]
    start, end, weight = triangles[:, [1, 2, 0]].ravel(), triangles[:, [2, 0, 1]].ravel(), cotangents.ravel() / 2
    edges = sparse.coo_array((weight, (start, end)), shape=(n, n))
    edges = (edges + edges.T).tocsc()
    mass = np.bincount(triangles.ravel(), np.repeat(double_area / 6, 3), minlength=n)
    return sparse.diags_array(edges.sum(0)).tocsc() - edges, mass
