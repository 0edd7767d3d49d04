"""Carry what the photo shows over the rim of the seen region, so that it fades into the prior without a seam."""

import igl
import numpy as np
import scipy.sparse as sparse
import torch
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu
from torch import Tensor

DETAIL_LENGTH = 0.001
"""Length below which differences between neighbouring observations are averaged [m]."""
FADE_LENGTH = 0.015
"""Distance over which the surface forgets the photo and returns to the prior [m]."""


def complete_field(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    observed: Float[Tensor, "V D"],
    confidence: Float[Tensor, "V"],
) -> Float[Tensor, "V D"]:
    """The smooth field that follows `observed` where it is known and fades to zero along the surface elsewhere.

    Minimises the integral over the surface of confidence |x - observed|^2 / detail^2 + |grad x|^2 + |x|^2 / fade^2,
    the screened Poisson equation (M (c / d^2 + 1 / l^2) + L) x = M c / d^2 observed, with libigl's cotangent Laplacian
    L and mass matrix M.
    """
    points = vertices.detach().cpu().numpy().astype(np.float64)
    triangles = faces.detach().cpu().numpy().astype(np.int64)
    laplacian = -igl.cotmatrix(points, triangles)
    mass = igl.massmatrix(points, triangles, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal().astype(np.float64)
    data = mass * confidence.detach().cpu().numpy().astype(np.float64) / DETAIL_LENGTH**2
    system = laplacian + sparse.diags(data + mass / FADE_LENGTH**2)
    right = data[:, None] * observed.detach().cpu().numpy().astype(np.float64)
    solution = splu(system.tocsc()).solve(np.ascontiguousarray(right))
    return torch.from_numpy(solution).to(observed)
