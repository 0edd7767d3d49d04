"""The colour of skin from its melanin and blood: a two-layer reflectance model over 31 wavelengths.

Melanin absorbs in the epidermis, crossed twice along uneven paths; haemoglobin in the dermis, whose diffuse
reflectance is a dipole (Jacques 2013; Prahl's haemoglobin spectra); CIE 1931 by the fits of Wyman et al. 2013, under
D65. Three free constants (the spread of paths, the slope of melanin, the gain of the dermis) are fitted to measured
skin colours from CIELAB L 72 to L 30. The measurements include specular reflection, of which 4 % stands for light that
never meets melanin; here half of that is left to the gloss, which is rendered separately, or dark skin would be chalky.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

_NM = np.arange(400.0, 701.0, 10.0)
# Molar absorption of oxygenated and of bare haemoglobin [1 / (cm M)].
_OXYGENATED = np.array([
    266232, 466840, 480360, 246072, 102580, 62816, 44480, 33209, 26629, 23684, 20933, 20035, 24202, 39957, 53236, 43016,
    32613, 44496, 50104, 14401, 3200, 1506, 942, 610, 442, 368, 320, 294, 278, 276, 290.0,
])  # fmt: skip
_BARE = np.array([
    223296, 303956, 407560, 528600, 413280, 103292, 23389, 16156, 14550, 16684, 20862, 25774, 31590, 39036, 46592,
    53412, 53788, 45072, 37020, 28324, 14677, 9444, 6510, 5149, 4345, 3750, 3227, 2795, 2408, 2052, 1794.0,
])  # fmt: skip
_D65 = np.array([
    82.75, 91.49, 93.43, 86.68, 104.86, 117.01, 117.81, 114.86, 115.92, 108.81, 109.35, 107.8, 104.79, 107.69, 104.41,
    104.05, 100, 96.33, 95.79, 88.69, 90.01, 89.6, 87.7, 83.29, 83.7, 80.03, 80.21, 82.28, 78.28, 69.72, 71.61,
])  # fmt: skip
_XYZ_TO_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
_WHITE = np.array([0.9505, 1.0, 1.089])

ABOVE_MELANIN = 0.018
"""Share of light that returns before it meets melanin, without specular reflection."""
REFLECTANCE_RANGE = (0.002, 0.95)
MELANIN_RANGE = (0.002, 0.8)
BLOOD_RANGE = (0.001, 0.15)
_TABLE = (48, 40)
"""Size of the table over melanin and blood."""


def _matching() -> np.ndarray:
    """The CIE observer's X, Y and Z under D65, each row summing to the white point."""

    def lobe(mean: float, left: float, right: float) -> np.ndarray:
        return np.exp(-0.5 * ((_NM - mean) / np.where(_NM < mean, left, right)) ** 2)

    x = 1.056 * lobe(599.8, 37.9, 31.0) + 0.362 * lobe(442.0, 16.0, 26.7) - 0.065 * lobe(501.1, 20.4, 26.2)
    y = 0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1)
    z = 1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8)
    rows = np.stack([x, y, z]) * _D65
    return rows / rows.sum(1, keepdims=True) * _WHITE[:, None]


_TO_RGB = _XYZ_TO_RGB @ _matching()


def _layers(
    melanin: np.ndarray, blood: np.ndarray, oxygen: float, epidermis: float, carotene: float
) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance of the epidermis, both ways, and reflectance of the dermis at each wavelength, [..., 31].

    Args:
        melanin: Volume fraction of melanosomes in the epidermis, [..., 1].
        blood: Volume fraction of blood in the dermis, [..., 1].
        oxygen: See `Tint`.
        epidermis: See `Tint`.
        carotene: See `Tint`.
    """
    bloodless = 0.244 + 85.3 * np.exp(-(_NM - 154) / 66.2)
    absorbed = blood * 2.303 * 150 / 64500 * (oxygen * _OXYGENATED + (1 - oxygen) * _BARE) + bloodless
    absorbed = absorbed + carotene * 6 * np.exp(-0.5 * ((_NM - 460) / 28) ** 2)
    scattered = 46.0 * (_NM / 500) ** -1.42
    albedo = scattered / (scattered + absorbed)
    depth = np.sqrt(3 * (1 - albedo))
    dermis = albedo / 2 * (1 + np.exp(-4 / 3 * 3.25 * depth)) * np.exp(-depth) * 1.12
    crossed = (melanin * 494 * (_NM / 550) ** -2.36 + bloodless) * epidermis * 1e-4 * 3.2
    return (1 + crossed / 4.75) ** -4.75, dermis


class Tint(NamedTuple):
    """Parameters that are constant over a part of one person's skin."""

    oxygen: float
    """Oxygen saturation of the haemoglobin."""
    epidermis: float
    """Thickness of the epidermis [um]."""
    carotene: float
    """Amount of yellow (carotene and a thick horn layer), 0 to about 0.4."""


def _table(tint: Tint) -> np.ndarray:
    """Linear sRGB reflectance of skin under D65 on a grid, [3, melanin, blood]."""
    melanin, blood = (np.geomspace(*r, n) for r, n in zip((MELANIN_RANGE, BLOOD_RANGE), _TABLE, strict=True))
    crossed, dermis = _layers(melanin[:, None], blood[:, None], *tint)
    # At each wavelength the layers multiply, so a colour is a matrix product.
    deep = (_TO_RGB[:, None] * crossed) @ dermis.T
    return (ABOVE_MELANIN * _TO_RGB.sum(1)[:, None, None] + (1 - ABOVE_MELANIN) * deep).clip(*REFLECTANCE_RANGE)


def skin_colors(
    melanin: Float[Tensor, "N"], blood: Float[Tensor, "N"], tints: Sequence[Tint]
) -> tuple[Float[Tensor, "3 N"], ...]:
    """Linear sRGB of skin for each of `tints`, interpolated in tables over log melanin and log blood.

    Melanin and blood are clamped to `MELANIN_RANGE` and `BLOOD_RANGE`.
    """
    tables = torch.from_numpy(np.concatenate([_table(tint) for tint in tints])).float().to(melanin.device)

    def place(values: Tensor, ends: tuple[float, float]) -> Tensor:
        low, high = np.log(ends)
        return (values.clamp(*ends).log() - low) * (2 / (high - low)) - 1

    where = torch.stack([place(blood, BLOOD_RANGE), place(melanin, MELANIN_RANGE)], -1)
    colors = grid_sample(tables[None], where[None, None], padding_mode="border", align_corners=True)[0, :, 0]
    return colors.split(3)
