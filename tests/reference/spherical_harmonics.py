"""Real spherical harmonics by SciPy's Legendre functions: nothing in common with the kernels' polynomials."""

import numpy as np
import torch
from scipy.special import sph_harm_y


def basis(degree, directions):
    """[N, (degree + 1)^2] in float64; directions [N, 3] need not be unit."""
    x, y, z = torch.nn.functional.normalize(directions.double(), dim=-1).numpy().T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for degree_l in range(degree + 1):
        for m in range(-degree_l, degree_l + 1):
            value = sph_harm_y(degree_l, abs(m), polar, azimuth)  # carries the Condon-Shortley sign
            if m < 0:
                columns.append(np.sqrt(2) * value.imag)
            elif m == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * value.real)
    return torch.from_numpy(np.stack(columns, -1))
