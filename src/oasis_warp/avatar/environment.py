"""Light from all around as nine harmonics of irradiance: that of an environment map, and that of a studio."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.sky import LOBE, harmonic_basis

DEGREES = (0, 1, 1, 1, 2, 2, 2, 2, 2)
SQUARES = (1, 1 / 3, 1 / 3, 1 / 3, 1 / 15, 1 / 15, 4 / 5, 1 / 15, 4 / 15)
"""Means over the sphere of the squares of the nine functions."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
STUDIO_FILL = 0.55
"""Even light of the studio; its lamps give the rest."""
STUDIO_LAMPS = (((-0.6, -0.6, -0.55), 0.85), ((0.8, -0.1, -0.6), 0.25), ((0.3, -0.6, 0.75), 0.45))
"""Directions to the lamps, as the photo's camera sees them (x right, y down, z forward), and how strong they are: a key
from above left, a fill from the right, and one from behind."""
SOFTNESS = (1.0, 0.9, 0.7)
"""What the size of the studio's lamps leaves of each degree."""


def environment_light(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "9 3"]:
    """Harmonics of the irradiance of an equirectangular picture of linear light (Ramamoorthi and Hanrahan 2001).

    As bright as even light of 1: the mean luminance over the sphere is 1. The middle of the picture lies where the
    photo's camera looks, behind the hand; its upper edge is above.

    Args:
        picture: Linear light, not negative and not all black, rows from above to below, columns from left to right.
    """
    height, width = picture.shape[:2]
    down = (torch.arange(height, dtype=torch.float64) + 0.5) * (math.pi / height)
    right = (torch.arange(width, dtype=torch.float64) + 0.5) * (2 * math.pi / width) - math.pi
    sine = down.sin()[:, None]
    rays = torch.stack([sine * right.sin(), -down.cos()[:, None].expand(-1, width), sine * right.cos()], -1)
    weights = (sine / (sine.sum() * width)).expand(-1, width).flatten()
    return _normalised(harmonic_basis(rays.view(-1, 3), 9), picture.double().view(-1, 3) * weights[:, None])


def studio_light() -> Float[Tensor, "9 3"]:
    """Harmonics of the irradiance of three large lamps in an even room, as bright as even light of 1."""
    directions = torch.tensor([direction for direction, _ in STUDIO_LAMPS], dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    soft = torch.tensor([SOFTNESS[degree] for degree in DEGREES], dtype=torch.float64)
    strengths = torch.tensor([[strength] * 3 for _, strength in STUDIO_LAMPS], dtype=torch.float64)
    room = torch.zeros(1, 9, dtype=torch.float64)
    room[0, 0] = 1
    basis = torch.cat([room, soft * harmonic_basis(directions, 9)])
    return _normalised(basis, torch.cat([torch.full((1, 3), STUDIO_FILL, dtype=torch.float64), strengths / 4]))


def _normalised(basis: Float[Tensor, "N 9"], light: Float[Tensor, "N 3"]) -> Float[Tensor, "9 3"]:
    """Irradiance of light from N directions, given their harmonics."""
    scale = torch.tensor([LOBE[d] / square for d, square in zip(DEGREES, SQUARES, strict=True)], dtype=torch.float64)
    harmonics = scale[:, None] * (basis.mT @ light)
    return (harmonics / (harmonics[0] @ harmonics.new_tensor(LUMINANCE))).float()
