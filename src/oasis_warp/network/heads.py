"""Gaussian heads: features -> attributes, as changes of the anchors and the mean colours (equation 8).

The last layer of a head starts at zero, so that an untrained network draws the mean hand. Faces mix the features of
their corners (Feature-on-Mesh, equation 7). For LoRA (Hu et al. 2022; the paper's appendix B.3) the fixed part of a
head is computed once.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import gelu, linear, normalize

from oasis_warp.avatar.anchors import OPACITY
from oasis_warp.core import rotation


class FeatureOnMesh(nn.Module):
    """Learnable barycentrics, one set a face, kept convex by a softmax; the centroid at first."""

    def __init__(self, n_faces: int):
        super().__init__()
        self.logits = nn.Parameter(torch.zeros(n_faces, 3))

    def forward(self, features: Float[Tensor, "B V C"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B F C"]:
        """Features of the faces."""
        weights = self.logits.softmax(-1)
        parts = (
            features.index_select(1, corner) * weight[:, None].to(features.dtype)
            for corner, weight in zip(faces.unbind(1), weights.unbind(1), strict=True)
        )
        return sum(parts, start=features.new_zeros(()))


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
    """Bounds of a head's outputs."""

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
    """Layer norm and a three-layer perceptron with named outputs."""

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
    delta = normalize(raw["quats"] + identity, dim=-1, eps=1e-6)
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
    return Attributes(rotation.multiply(quats, delta), scales * change.exp(), fade * opacity, color)


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


COLOR_OUTPUTS = ("colors", "trust")
"""Outputs of a head that make colours, where it has them."""


class HeadCache(NamedTuple):
    """One frozen head and its inputs: a row for each Gaussian."""

    inputs: Float[Tensor, "N C"]
    """Features after the norm."""
    first: Float[Tensor, "N H"]
    """What the first layer makes of them."""
    second: tuple[Float[Tensor, "H H"], Float[Tensor, "H"]]
    last: tuple[Float[Tensor, "K H"], Float[Tensor, "K"]]
    """Weight and bias; the last layer's are those of `outputs`."""
    outputs: dict[str, int]
    """Names and sizes of the K outputs."""
    colors: Float[Tensor, "N 3"]
    """Mean colours, which outputs are changes of."""
    seen: Float[Tensor, "N 3"] | None
    """What the photo shows instead of them, where the head is told [logits]."""


ColorHeads = tuple[HeadCache, ...]
"""Cache of the vertices' Gaussians, then of the faces' where these have a head: all of a guess, in its order."""

LowRank = list[tuple[Tensor, Tensor]]
"""A head's updates, one a layer: A of shape [rank, inputs] and the transpose of B, [rank, outputs]; the layer's weight
gets B A more."""


@torch.no_grad()
def cache_head(
    head: GaussianHead,
    features: Float[Tensor, "M C"],
    colors: Float[Tensor, "M 3"],
    seen: Float[Tensor, "M 3"] | None,
    rows: Int[Tensor, "N"],
) -> HeadCache:
    """What `head` needs for the colours of N Gaussians.

    Args:
        head: Copied as far as it is needed, so that later training does not change it.
        features: What it is asked.
        colors: Mean colours of the same points.
        seen: The photo's difference from them, if the head puts out how far to trust it.
        rows: The row whose colour each Gaussian has.
    """
    inputs = head.norm(features[rows])
    ends = torch.tensor(list(head.outputs.values())).cumsum(0).tolist()
    kept = [k for k, name in enumerate(head.outputs) if name in COLOR_OUTPUTS]
    slices = [slice(ends[k] - list(head.outputs.values())[k], ends[k]) for k in kept]
    return HeadCache(
        inputs=inputs,
        first=head.first(inputs),
        second=(head.second.weight.clone(), head.second.bias.clone()),
        last=tuple(torch.cat([part[where] for where in slices]) for part in (head.last.weight, head.last.bias)),
        outputs={name: size for name, size in head.outputs.items() if name in COLOR_OUTPUTS},
        colors=colors[rows],
        seen=None if seen is None else seen[rows],
    )


def zero_updates(cache: HeadCache, rank: int | None, random: torch.Generator) -> LowRank:
    """Updates of the three layers that change nothing yet: A uniform up to 1 / sqrt(inputs), B zero.

    Without a rank A is the identity, and wants no gradient: B A may be any matrix.

    Args:
        cache: Cache of the head.
        rank: Rank of B A; None for all weights.
        random: On the CPU, so that every device starts alike.
    """
    hidden = cache.first.shape[1]
    sizes = (cache.inputs.shape[1], hidden), (hidden, hidden), (hidden, len(cache.last[1]))
    updates = []
    for inputs, outputs in sizes:
        down = torch.eye(inputs)
        if rank is not None:
            down = (2 * torch.rand(rank, inputs, generator=random) - 1) / math.sqrt(inputs)
        up = cache.first.new_zeros(len(down), outputs)
        updates.append((down.to(cache.first).requires_grad_(rank is not None), up.requires_grad_()))
    return updates


def head_colors(cache: HeadCache, updates: LowRank) -> Float[Tensor, "N 3"]:
    """Colours of the Gaussians with the updates; differentiable in them."""
    (down, up), second, last = updates
    hidden = gelu(cache.first + linear(cache.inputs, down) @ up)
    hidden = gelu(_updated(hidden, cache.second, second))
    raw = _updated(hidden, cache.last, last)
    parts = dict(zip(cache.outputs, raw.split(list(cache.outputs.values()), dim=-1), strict=True))
    return decode_colors(parts, cache.colors, cache.seen)


def _updated(inputs: Tensor, layer: tuple[Tensor, Tensor], update: tuple[Tensor, Tensor]) -> Tensor:
    """A layer with its update added to the weight: one product with all rows instead of three."""
    (weight, bias), (down, up) = layer, update
    return linear(inputs, weight + up.T @ down, bias)
