"""Real spherical harmonics by recurrence over degree and order, and the colours they stand for."""

import math

import torch
from torch import Tensor


def basis(degree: int, directions: Tensor) -> Tensor:
    """Values [..., (degree + 1)^2] along directions [..., 3] of any length, orders -l .. l of degrees l = 0, 1, ...

    With x + i y = sin(polar) e^(i azimuth), the functions are K_lm P_lm(z) times the real or imaginary part of
    (x + i y)^m, where P_lm is the Legendre function over sin^m. Signs are those of graphics: (-1)^m.
    """
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    real, imaginary = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):
        real.append(real[-1] * x - imaginary[-1] * y)
        imaginary.append(real[-2] * y + imaginary[-1] * x)
    legendre = {}
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(z, math.prod(range(1, 2 * m, 2)) * (-1) ** m)
        for n in range(m + 1, degree + 1):
            before = legendre[n - 2, m] if n - 2 >= m else torch.zeros_like(z)
            legendre[n, m] = ((2 * n - 1) * z * legendre[n - 1, m] - (n + m - 1) * before) / (n - m)
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            size = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - k) / math.factorial(n + k))
            part = imaginary[k] if m < 0 else real[k]
            columns.append((math.sqrt(2) if m else 1.0) * size * legendre[n, k] * part)
    return torch.stack(columns, -1)


def sh_to_rgb(degree: int, means: Tensor, coefficients: Tensor, viewmats: Tensor) -> Tensor:
    """Colours [C, N, 3] of coefficients [N, K, 3] or [C, N, K, 3], seen from each camera."""
    centres = -(torch.linalg.inv(viewmats[:, :3, :3]) @ viewmats[:, :3, 3:])[..., 0]
    values = basis(degree, means - centres[:, None])
    used = coefficients[..., : (degree + 1) ** 2, :]
    return ((values[..., None] * used).sum(-2) + 0.5).clamp(min=0)
