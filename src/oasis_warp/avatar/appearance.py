"""Mean appearance of a hand by region: palm, back, finger tips, knuckles, creases and nails, for any skin tone.

The table of skin colours holds sRGB values of a two-layer reflectance model: melanin absorbs in the epidermis, crossed
twice along uneven paths; haemoglobin (70 % oxygenated) absorbs in the dermis, whose diffuse reflectance is a dipole
(Jacques 2013; Prahl's haemoglobin spectra), integrated over CIE 1931 under D65. Its four free constants were fitted to
eight measured skin colours from CIELAB L 72 to L 30, all within 1.6 units.
"""

import functools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core import surface
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel

MELANIN = (0.005, 0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.35)
"""Volume share of melanosomes in the epidermis: light to dark."""
BLOOD = (0.005, 0.012, 0.02, 0.04)
"""Volume share of blood in the dermis."""
_SRGB_8BIT = (
    ((206, 184, 163), (200, 168, 148), (194, 156, 138), (184, 139, 122)),
    ((203, 179, 157), (196, 163, 142), (191, 152, 133), (181, 135, 118)),
    ((196, 170, 145), (190, 155, 132), (184, 145, 123), (175, 129, 110)),
    ((183, 154, 126), (177, 141, 115), (172, 131, 108), (164, 117, 98)),
    ((161, 129, 100), (156, 118, 93), (152, 111, 88), (145, 100, 81)),
    ((132, 101, 76), (128, 93, 72), (125, 88, 70), (119, 81, 67)),
    ((104, 79, 63), (101, 75, 62), (99, 72, 61), (95, 68, 60)),
    ((87, 68, 59), (85, 66, 58), (83, 64, 58), (81, 62, 58)),
)


def skin_color(melanin: Float[Tensor, "N"], blood: Float[Tensor, "N"]) -> Float[Tensor, "N 3"]:
    """SRGB in [0, 1] of skin, interpolated over the logarithms of both shares; values beyond the table are clamped."""
    table = torch.tensor(_SRGB_8BIT, dtype=melanin.dtype, device=melanin.device) / 255

    def place(values: Tensor, knots: tuple[float, ...]) -> tuple[Tensor, Tensor]:
        grid = torch.tensor(knots, dtype=values.dtype, device=values.device).log()
        x = values.clamp(knots[0], knots[-1]).log()
        low = (torch.searchsorted(grid, x, right=True) - 1).clamp(0, len(knots) - 2)
        return low, ((x - grid[low]) / (grid[low + 1] - grid[low]))[:, None]

    i, u = place(melanin, MELANIN)
    j, v = place(blood, BLOOD)
    return (1 - u) * ((1 - v) * table[i, j] + v * table[i, j + 1]) + u * (
        (1 - v) * table[i + 1, j] + v * table[i + 1, j + 1]
    )


BLOOD_MEAN = 0.0125
"""Blood share of the back of the hand; one value serves the whole range of tones."""
PALM_SMOOTHING = 5
"""Passes over the mesh that soften the border between palm and back."""
PALM_BORDER = (0.36, 0.74)
"""Shares of what faces the palm, thus smoothed, between which skin changes from that of backs to that of palms."""
BALL_PASSES, AT_BALL = 120, 1.5
"""Passes that smooth this border beside the ball of the thumb, 20 mm, and the factor of where that is."""
WRIST_END = (-0.009, 0.009)
"""Range of the rest pose's x axis, which points up the arm, over which the palm's kind of skin ends [m]."""
NAIL_WHITE = 0.14
"""Share of white that the nail plate adds."""
NAIL_RIM_SHADE = 0.25
"""How much darker the fold around the nail is."""


MOTTLE_PASSES = (2, 25)
"""Smoothings of white noise that give the fine and the coarse blotches of skin: about 3 and 12 mm."""
MOTTLE_MELANIN, MOTTLE_BLOOD = 0.07, 0.12
"""Standard deviations of the blotches, as shares of melanin and blood: evenly coloured skin looks like plastic."""


class Regions(NamedTuple):
    """Where things are on the surface, each in [0, 1]; `mottle` has mean 0 and standard deviation 1."""

    palm: Float[Tensor, "V"]
    finger_tip: Float[Tensor, "V"]
    knuckle: Float[Tensor, "V"]
    crease: Float[Tensor, "V"]
    nail: Float[Tensor, "V"]
    mottle: Float[Tensor, "V"]


def _mottle(n_vertices: int, edges: Tensor) -> Tensor:
    noise = torch.randn(n_vertices, 1, generator=torch.Generator().manual_seed(0)).to(edges.device)
    layers = [surface.smooth_over_mesh(noise, edges, passes)[:, 0] for passes in MOTTLE_PASSES]
    total = sum((layer - layer.mean()) / layer.std() for layer in layers)
    return total / total.std()


def _smoothstep(x: Tensor, low: float, high: float) -> Tensor:
    t = ((x - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def _bump(x: Tensor, center: float, width: float) -> Tensor:
    return torch.exp(-(((x - center) / width) ** 2))


@functools.lru_cache(4)
@torch.inference_mode(False)  # what is kept may be read where gradients are wanted
def label_regions(hand: HandModel) -> Regions:
    """Soft region labels from the model's bone coordinates; kept, so not to be written to."""
    edges = surface.mesh_edges(hand.faces)
    palm = surface.smooth_over_mesh(_toward_palm(hand)[:, None], edges, PALM_SMOOTHING)[:, 0]
    palm = _smoothstep(palm, *PALM_BORDER)
    level = torch.where(hand.segment == 0, 0, (hand.segment - 1) % 3 + 1)  # 0 hand, 1 to 3 along a finger
    on_finger = level > 0
    tip = torch.where(level == 3, _smoothstep(hand.bone_t, 0.35, 0.8), 0)
    at_joint = torch.where(on_finger, _bump(hand.bone_t, 0.0, 0.16), 0) + torch.where(
        (level == 1) | (level == 2), _bump(hand.bone_t, 1.0, 0.16), 0
    )
    knuckle = at_joint.clamp(max=1) * (1 - palm)
    bent = level >= 2
    crease = torch.where(bent, _bump(hand.bone_t, 0.0, 0.05), 0) + torch.where(
        (level == 1) | (level == 2), _bump(hand.bone_t, 1.0, 0.05), 0
    )
    crease = (crease + torch.where(level == 1, _bump(hand.bone_t, 0.52, 0.05), 0)).clamp(max=1) * palm
    soften = surface.smooth_over_mesh(torch.stack([tip, knuckle, crease], -1), edges, 1)
    return Regions(
        palm, *soften.unbind(-1), _smoothstep(hand.nail, 0.3, 0.7), _mottle(len(hand.template), edges)
    )


def _toward_palm(hand: HandModel) -> Float[Tensor, "V"]:
    """0 on the back of each vertex's bone, 1 on its palm's side."""
    return 0.5 - 0.5 * torch.cos(hand.bone_theta)


@functools.lru_cache(4)
@torch.inference_mode(False)
def skin_regions(hand: HandModel) -> Regions:
    """`label_regions` with the palm's skin as it lies on real hands; kept, so not to be written to.

    The angles about the bones jump between the ball of the thumb and the wrist, and so does the palm of those labels:
    painted, it was a stain. This border crosses the ball in one line, and the wrist's skin is that of a back.
    """
    edges = surface.mesh_edges(hand.faces)
    both = torch.stack([_toward_palm(hand), (hand.segment == TIP_JOINTS[0] - 2).float()], 1)
    near = surface.smooth_over_mesh(both, edges, PALM_SMOOTHING)
    wide, share = surface.smooth_over_mesh(near, edges, BALL_PASSES - PALM_SMOOTHING).unbind(1)
    beside = (AT_BALL * 4 * share * (1 - share)).clamp(max=1)
    palm = _smoothstep(torch.lerp(near[:, 0], wide, beside), *PALM_BORDER)
    palm = palm * (1 - _smoothstep(hand.template[:, 0], *WRIST_END))
    return label_regions(hand)._replace(palm=palm)


def skin_melanin(palm: Float[Tensor, "V"], melanin: float) -> Float[Tensor, "V"]:
    """Share of melanin in smooth skin of a hand whose back has the share `melanin`, given what is `palm`.

    Palms hold about a third of the melanin of backs, and light ones no less: the difference grows with the tone.
    """
    palm_melanin = min(0.6 * melanin, 0.006 + 0.33 * melanin)
    return ((1 - palm) * math.log(melanin * 1.15) + palm * math.log(palm_melanin)).exp()


def nail_color(melanin: Float[Tensor, "N"]) -> Float[Tensor, "N 3"]:
    """Evenly lit sRGB colours of nails among skin of such shares of melanin: their beds, seen through the plates."""
    bed = skin_color(0.5 * melanin, torch.full_like(melanin, 1.9 * BLOOD_MEAN))
    return (1 - NAIL_WHITE) * bed + NAIL_WHITE


def region_colors(regions: Regions, melanin: float) -> Float[Tensor, "V 3"]:
    """Evenly lit sRGB colours of a hand whose back has the given `melanin` share."""
    palm, tip, knuckle, crease, nail, mottle = regions
    smooth = skin_melanin(palm, melanin)
    amount = smooth * (1 + 0.3 * knuckle + 0.25 * crease) * (1 + MOTTLE_MELANIN * mottle)
    blood = BLOOD_MEAN * (1 + 0.35 * palm + 0.9 * tip * (0.4 + 0.6 * palm) + 0.7 * knuckle + 0.4 * crease)
    blood = blood * (1 + MOTTLE_BLOOD * mottle)
    skin = skin_color(amount, blood)
    shade = 1 - 0.10 * crease - 0.04 * knuckle - NAIL_RIM_SHADE * 4 * nail * (1 - nail)
    return ((1 - nail[:, None]) * skin + nail[:, None] * nail_color(smooth)) * shade[:, None]


def region_masks(regions: Regions) -> dict[str, Float[Tensor, "V"]]:
    """Weights that split the surface into palm, back and nail, for statistics."""
    skin = 1 - regions.nail
    return {"palm": regions.palm * skin, "back": (1 - regions.palm) * skin, "nail": regions.nail}
