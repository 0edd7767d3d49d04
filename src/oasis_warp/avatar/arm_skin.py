"""The skin of the arm: the tone of the hand's before the wrist, with a pattern of its own."""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import centers_at_rest
from oasis_warp.avatar.cells import CELL, LONGER, TRIED, apart, blotches, furrows_and_tones
from oasis_warp.core.types import CanonicalGaussians

SMOOTHING = 0.0015
"""Standard deviation of the average of the hand's colours, where they are nearest [m]."""
PLACES = 4000
"""About as many places of the hand's skin count for that average."""
BLOTCHES = (0.0011, 0.02), (0.0022, 0.03), (0.006, 0.025)
"""Least distances of the points that blotches are made of [m], and what they add to logarithms."""
BLOOD = 0.7, 1.0, 1.0
"""Of a blotch, in red, green and blue."""
SPAN = -0.04, 0.125
"""The stretch along the arm that has a pattern, from the rim [m]."""


def arm_colors(
    skin: CanonicalGaussians, rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], rim: Int[Tensor, "R"],
    axis: Float[Tensor, "3"], points: Float[Tensor, "M 3"], seed: int,
) -> Float[Tensor, "M 3"]:  # fmt: skip
    """Colours at `points` of the arm.

    They are averages of the hand's skin, and wider where that is farther away: with one width the middle of the arm
    would have wedges of one colour each. The pattern lies on a cylinder around the arm, and ends towards its axis.
    Skin of the hand in the mirror looked like grain of wood.

    Args:
        skin: Gaussians of the hand before the arm.
        rest: The surface at rest [m].
        faces: Its faces.
        rim: Vertices where it ends.
        axis: Direction of the arm.
        points: Where colours are wanted [m].
        seed: Of the pattern.
    """
    centers = centers_at_rest(skin, rest, faces)
    thin = slice(None, None, max(1, round(len(centers) / PLACES)))
    squared = torch.cdist(points, centers[thin]).square()
    spread = SMOOTHING**2 + squared.amin(1, keepdim=True)
    tone = torch.softmax(-0.5 * squared / spread, 1) @ skin.colors[thin]
    arm = points - rest[rim].mean(0)
    along = arm @ axis
    arm, radius = arm - along[:, None] * axis, float((rest[rim] - rest[rim].mean(0)).norm(dim=1).mean())
    across = normalize(torch.linalg.cross(axis, rest[rim[0]] - rest[rim].mean(0)), dim=0)
    around = torch.atan2(arm @ torch.linalg.cross(axis, across), arm @ across)
    pattern = _pattern(radius, around.cpu().double().numpy(), along.cpu().double().numpy(), seed)
    outer = (2 * arm.norm(dim=1) / radius - 1).clamp(0, 1)[:, None]
    return (tone * (torch.from_numpy(pattern).to(tone) * outer).exp()).clamp(max=1)


def _pattern(radius: float, around: np.ndarray, along: np.ndarray, seed: int) -> np.ndarray:
    """What is added to the logarithms of colours at angles around the arm and places along it [m]."""

    def on_cylinder(angle: np.ndarray, place: np.ndarray, stretch: float) -> np.ndarray:
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), stretch * place], 1)

    def scattered(distance: float, seed: int, stretch: float = 1.0) -> cKDTree:
        generator = torch.Generator().manual_seed(seed)
        area = 2 * math.pi * radius * (SPAN[1] - SPAN[0]) * stretch
        count = round(TRIED * area / distance**2)
        angle, place = torch.rand(2, count, generator=generator, dtype=torch.float64).numpy()
        place = SPAN[0] + place * (SPAN[1] - SPAN[0])
        return cKDTree(apart(on_cylinder(2 * math.pi * angle, place, stretch), distance))

    grain = furrows_and_tones(scattered(CELL, seed + 8, LONGER), on_cylinder(around, along, LONGER), seed + 9)
    blood = np.zeros_like(grain)
    for k, (distance, strength) in enumerate(BLOTCHES):
        among = scattered(distance, seed + 10 + 2 * k)
        blood += strength * blotches(among, on_cylinder(around, along, 1.0), distance, seed + 11 + 2 * k)
    return grain[:, None] + blood[:, None] * np.array(BLOOD)
