"""Gaussian heads: features -> attributes, as changes of the anchors and the mean colours (equation 8).

The last layer of a head starts at zero, so that an untrained network draws the mean hand.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import gelu, normalize

from oasis_warp.avatar.anchors import OPACITY
from oasis_warp.core import rotation

MAX_OFFSET = 0.012
"""Farthest that a vertex Gaussian can leave its vertex along an axis [m]; the loss pulls from half of it on."""
COLOR_MARGIN = 1e-3
"""Distance that mean colours keep from 0 and 1, where the logit ends."""
SHARED = {"quats": 4, "scales": 3, "opacities": 1, "colors": 3}
VERTEX_OUTPUTS = {**SHARED, "offsets": 3}
FACE_OUTPUTS = {**SHARED, "barycentrics": 3}
TRUST = {"trust": 1}
"""Further output where points are told what the photo shows of them: how much of it to take over."""


class Limits(NamedTuple):
    """How far a head may go."""

    growth: float
    """A Gaussian is at most this much larger than its anchor."""
    shrink: tuple[float, float, float]
    """And at most this much smaller, along each axis."""
    opacity: float
    """Least opacity, before the wrist's fade."""


VERTEX_LIMITS, FACE_LIMITS = Limits(4.0, (4.0, 4.0, 4.0), 0.0), Limits(1.5, (1.5, 1.5, 4.0), 0.8)
"""Free to, faces vanish in training, as large smooth Gaussians on vertices draw skin well enough; but texture learning
needs something small and opaque to paint a photo's detail on. Thin they may get: it keeps them within the outline."""


class GaussianHead(nn.Module):
    """Layer norm and a three-layer perceptron that names what it puts out."""

    def __init__(self, width: int, hidden: int, outputs: dict[str, int]):
        super().__init__()
        self.outputs = outputs
        self.norm = nn.LayerNorm(width)
        self.first, self.second = nn.Linear(width, hidden), nn.Linear(hidden, hidden)
        self.last = nn.Linear(hidden, sum(outputs.values()))
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, features: Float[Tensor, "B N C"]) -> dict[str, Float[Tensor, "B N _"]]:
        """Raw outputs in float32, without a unit; 0 means no change."""
        raw = self.last(gelu(self.second(gelu(self.first(self.norm(features)))))).float()
        return dict(zip(self.outputs, raw.split(list(self.outputs.values()), dim=-1), strict=True))


class Attributes(NamedTuple):
    """What vertex and face Gaussians have in common."""

    quats: Float[Tensor, "B N 4"]
    scales: Float[Tensor, "B N 3"]
    opacities: Float[Tensor, "B N"]
    colors: Float[Tensor, "B N 3"]


def decode(
    raw: dict[str, Tensor],
    quats: Float[Tensor, "B N 4"],
    scales: Float[Tensor, "B N 3"],
    fade: Float[Tensor, "B N"],
    colors: Float[Tensor, "B N 3"],
    seen: Float[Tensor, "B N 3"] | None,
    limits: Limits,
) -> Attributes:
    """Apply raw outputs to anchors and mean colours; raw zeros return them.

    A rotation turns in the anchor's own frame, a scale grows by exp of a bounded number, opacity moves in logits from
    `limits.opacity` up, below what the wrist's fade allows, colour moves in logits, and with `seen`, the photo's
    difference from `colors` in logits, by the share of it that the head trusts.
    """
    identity = torch.nn.functional.pad(torch.ones_like(raw["quats"][..., :1]), (0, 3))
    turn = normalize(raw["quats"] + identity, dim=-1, eps=1e-6)
    larger = math.log(limits.growth)
    shrunk = torch.stack([  # no tensor of the limits: a recording could not bring it to the device
        math.log(limit) * torch.tanh(axis / math.log(limit))
        for axis, limit in zip(raw["scales"].unbind(-1), limits.shrink, strict=True)
    ], dim=-1)  # fmt: skip
    change = torch.where(raw["scales"] > 0, larger * torch.tanh(raw["scales"] / larger), shrunk)
    least = limits.opacity
    opacity = least + (1 - least) * torch.sigmoid(
        raw["opacities"][..., 0] + math.log((OPACITY - least) / (1 - OPACITY))
    )
    color = decode_colors(raw, colors, seen)
    return Attributes(rotation.multiply(quats, turn), scales * change.exp(), fade * opacity, color)


def decode_colors(
    raw: dict[str, Tensor], colors: Float[Tensor, "*batch 3"], seen: Float[Tensor, "*batch 3"] | None
) -> Float[Tensor, "*batch 3"]:
    """The colours of `decode`."""
    color = raw["colors"] + torch.logit(colors, COLOR_MARGIN)
    if seen is not None:
        color = color + raw["trust"] * seen
    return torch.sigmoid(color)


def decode_offsets(raw: dict[str, Tensor]) -> Float[Tensor, "B V 3"]:
    """Shifts of vertex Gaussians [m]: a raw 1 is about 10 mm."""
    return MAX_OFFSET * torch.tanh(raw["offsets"])
