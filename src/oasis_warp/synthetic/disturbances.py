"""What else a photo of a hand may show: things before or behind it, other hands, skin-coloured surroundings, motion.

All of it is drawn in linear light, on the device of the pictures, from a generator on that device.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import affine_grid, conv2d, grid_sample, interpolate

THINGS, THING_SHARE = 3, 0.1
"""Things in a photo at most, and the probability of each."""
HAND_BEFORE, HAND_BEHIND, SKIN_BEHIND, BLURRED = 0.07, 0.2, 0.15, 1 / 7
"""Shares of photos with another hand before or behind, with skin-coloured surroundings, and with motion blur."""
BLUR_REACH = 8
"""Longest motion blur, to either side [px]."""
LIGHT_SKIN, DARK_SKIN = (0.62, 0.40, 0.28), (0.14, 0.075, 0.045)
"""Rough reflectances, linear RGB."""


class Disturbed(NamedTuple):
    """Pictures with what was put into them."""

    light: Float[Tensor, "B H W 3"]
    """Linear light."""
    front: Float[Tensor, "B H W"]
    """Share of each pixel that shows something in front of the hand."""


def disturb(
    light: Float[Tensor, "B H W 3"],
    color: Float[Tensor, "B H W 3"],
    alpha: Float[Tensor, "B H W"],
    depth: Float[Tensor, "B H W"],
    incident: Float[Tensor, "B 3"],
    random: torch.Generator,
) -> Disturbed:
    """Put things, other hands, skin-coloured surroundings and motion blur into pictures.

    Args:
        light: Linear light of hand and background.
        color: Linear light of the hand alone, multiplied by `alpha`; the next picture's hand is the other hand.
        alpha: Share of each pixel that is hand or arm.
        depth: Depth of the hand [m]; +inf where there is none.
        incident: Light on each hand, linear RGB.
        random: Generator on the device of the pictures.
    """
    front = torch.zeros_like(alpha)
    count, size = len(light), light.shape[1]
    middle = torch.where(depth.isfinite(), depth, torch.nan).flatten(1).nanmedian(1).values.nan_to_num(0.5)
    for _ in range(THINGS):
        thing, share = _thing(count, size, incident, random)
        share = share * _chance(count, THING_SHARE, random)
        # What a hand holds lies between fingers and palm, so its depth is within that of the hand.
        at = middle[:, None, None] + _uniform(random, count, 1, 1, low=-0.06, high=0.05)
        visible = share * torch.where(depth < at, 1 - alpha, 1.0)
        light = light + visible[..., None] * (thing - light)
        front = front + (alpha > 0.02) * visible * (1 - front)
    other, other_alpha = _other_hand(color, alpha, incident, random)
    before = _chance(count, HAND_BEFORE, random)
    behind = _chance(count, HAND_BEHIND, random) * (1 - before)
    hidden = torch.maximum(alpha, front)
    shown = (before + behind * (1 - hidden))[..., None]
    light = light * (1 - shown * other_alpha[..., None]) + shown * other
    front = torch.maximum(front, before * other_alpha)
    around = _oval(count, size, random) * _chance(count, SKIN_BEHIND, random) * (1 - hidden)
    around = around * (1 - torch.maximum(before, behind) * other_alpha)
    skin = _skin_tone(count, random) * incident * _uniform(random, count, 1, low=0.5, high=1.1)
    light = light + around[..., None] * (skin[:, None, None] - light)
    return Disturbed(_motion_blur(light, random), front)


def _uniform(random: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=random, device=random.device)


def _chance(count: int, probability: float, random: torch.Generator) -> Tensor:
    """1 with a probability, else 0, [B, 1, 1]."""
    return (_uniform(random, count, 1, 1) < probability).float()


def _skin_tone(count: int, random: torch.Generator) -> Float[Tensor, "B 3"]:
    light, dark = (torch.tensor(tone, device=random.device) for tone in (LIGHT_SKIN, DARK_SKIN))
    t = _uniform(random, count, 1)
    return light ** (1 - t) * dark**t


def _coordinates(size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Pixel centres along x and y, -1 to 1 over the picture."""
    at = (torch.arange(size, device=device) + 0.5) / size * 2 - 1
    return at[None, None, :], at[None, :, None]


def _noise(count: int, size: int, cells: int, random: torch.Generator) -> Float[Tensor, "B H W"]:
    grid = torch.randn(count, 1, cells, cells, generator=random, device=random.device)
    return interpolate(grid, size=(size, size), mode="bicubic", align_corners=False)[:, 0]


def _oval(count: int, size: int, random: torch.Generator) -> Float[Tensor, "B H W"]:
    """Large soft ovals, as of faces and bodies."""
    x, y = _coordinates(size, random.device)
    u, v = (_uniform(random, count, 1, 1, low=-1.2, high=1.2) for _ in range(2))
    a, b = (_uniform(random, count, 1, 1, low=0.3, high=1.2) for _ in range(2))
    radius = ((x - u) / a) ** 2 + ((y - v) / b) ** 2 + 0.25 * _noise(count, size, 5, random)
    return torch.sigmoid((1 - radius) * _uniform(random, count, 1, 1, low=6.0, high=30.0))


def _thing(count: int, size: int, incident: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """A rod, box or disc, shaded across: its light, [B, H, W, 3], and its share of each pixel."""
    x, y = _coordinates(size, random.device)
    angle = _uniform(random, count, 1, 1, high=math.pi)
    u, v = (_uniform(random, count, 1, 1, low=-0.6, high=0.6) for _ in range(2))
    length = _uniform(random, count, 1, 1, low=0.15, high=1.2)
    width = (length * torch.exp(_uniform(random, count, 1, 1, low=-2.8, high=-0.4))).clamp_min(0.03)
    power = 2.0 ** _uniform(random, count, 1, 1, low=1.0, high=3.5)  # an ellipse to nearly a rectangle
    along = ((x - u) * angle.cos() + (y - v) * angle.sin()) / length
    across = (-(x - u) * angle.sin() + (y - v) * angle.cos()) / width
    radius = (along.abs().clamp_max(4) ** power + across.abs().clamp_max(4) ** power) ** (1 / power)
    share = ((1 - radius) * width * size / 2 + 0.5).clamp(0, 1)
    round_shade = (1 - 0.8 * _uniform(random, count, 1, 1) * across.abs().clamp_max(1) ** 2).clamp_min(0.1)
    skinlike = (_uniform(random, count, 1) < 0.3).float()
    albedo = skinlike * _skin_tone(count, random) + (1 - skinlike) * _uniform(random, count, 3) ** 2
    pattern = (1 + 0.35 * _uniform(random, count, 1, 1) * _noise(count, size, 24, random)).clamp_min(0.1)
    return (albedo * incident)[:, None, None] * (round_shade * pattern)[..., None], share


def _other_hand(color: Tensor, alpha: Tensor, incident: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """The hand of the next picture, rotated, scaled and shifted: its light, multiplied by its alpha, and alpha."""
    count, size = alpha.shape[:2]
    gain = incident / incident.roll(1, 0).clamp_min(1e-4)
    layers = torch.cat([color.roll(1, 0) * gain[:, None, None], alpha.roll(1, 0)[..., None]], -1)
    angle = _uniform(random, count, low=-math.pi, high=math.pi)
    scale = _uniform(random, count, low=0.7, high=1.6)
    flip = torch.where(_uniform(random, count) < 0.5, -1.0, 1.0)
    x, y = (_uniform(random, count, low=-1.0, high=1.0) for _ in range(2))
    cos, sin = scale * angle.cos(), scale * angle.sin()
    rows = torch.stack([cos * flip, -sin, x, sin * flip, cos, y], 1).view(-1, 2, 3)
    grid = affine_grid(rows, [count, 1, size, size], align_corners=False)
    moved = grid_sample(layers.permute(0, 3, 1, 2), grid, align_corners=False)
    return moved[:, :3].permute(0, 2, 3, 1), moved[:, 3].clamp(0, 1)


def _motion_blur(light: Tensor, random: torch.Generator) -> Tensor:
    """Some of the pictures blurred along a line."""
    count, size = light.shape[:2]
    reach = torch.arange(-BLUR_REACH, BLUR_REACH + 1, device=light.device, dtype=light.dtype)
    angle = _uniform(random, count, 1, 1, high=math.pi)
    length = _uniform(random, count, 1, 1, low=1.0, high=float(BLUR_REACH)) * _chance(count, BLURRED, random)
    along = reach[None, :, None] * angle.sin() + reach[None, None, :] * angle.cos()
    across = reach[None, None, :] * angle.sin() - reach[None, :, None] * angle.cos()
    kernel = torch.exp(-2 * across**2) * torch.sigmoid((length / 2 - along.abs() + 0.5) * 4)
    kernel = kernel / kernel.sum((1, 2), keepdim=True)
    planes = light.permute(0, 3, 1, 2).reshape(1, count * 3, size, size)
    planes = conv2d(planes, kernel.repeat_interleave(3, 0)[:, None], padding=BLUR_REACH, groups=count * 3)
    return planes.view(count, 3, size, size).permute(0, 2, 3, 1)
