"""Colours: sRGB as linear light, its luminance, and CIELAB."""

import torch
from jaxtyping import Float
from torch import Tensor

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Share of linear red, green and blue in the luminance (ITU-R BT.709)."""
_XYZ = ((0.4124, 0.3576, 0.1805), LUMINANCE, (0.0193, 0.1192, 0.9505))
_KNEE = 6 / 29
"""Where CIELAB's cube root goes over into a line."""


def linear_light(srgb: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Linear light of sRGB colours, both in [0, 1] (IEC 61966-2-1)."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def luminance(srgb: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Luminance of sRGB colours, 1 for white."""
    return linear_light(srgb) @ srgb.new_tensor(LUMINANCE)


def cielab(srgb: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """L* in [0, 100], a* (green to red) and b* (blue to yellow) of sRGB colours under D65 (CIE 1976)."""
    matrix = srgb.new_tensor(_XYZ)
    share = linear_light(srgb) @ (matrix / matrix.sum(1, keepdim=True)).T
    line = share / (3 * _KNEE**2) + 4 / 29
    x, y, z = torch.where(share > _KNEE**3, share.clamp_min(1e-9) ** (1 / 3), line).unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)
