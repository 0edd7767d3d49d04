"""Point-aligned features (equations 1 and 2) and the visual evidence tokens made of them (equation 3)."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad

from oasis_warp.avatar.observation import Observation, sample
from oasis_warp.avatar.prior import MeanHand
from oasis_warp.network.attention import MASKED_LOGIT, FeedForward, SelfAttention, attend, join_heads, split_heads
from oasis_warp.network.encoders import ImageFeatures
from oasis_warp.network.heads import COLOR_MARGIN


def encode(x: Float[Tensor, "*batch D"], frequencies: int) -> Float[Tensor, "*batch E"]:
    """Sines and cosines of 2^l pi x for l below `frequencies`; E = 2 D frequencies. Meant for x in [-1, 1]."""
    octaves = math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = (x[..., None] * octaves).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Aggregation(nn.Module):
    """Distance-weighted mean of K x K bilinear samples, one cell apart, round each projection (equation 2).

    Samples lie at fixed offsets from the point, so their weights are the same for all points: the weighted sum of
    samples is one sample of the map convolved with the weights, at 1 / K^2 of the work. A sample counts by the share
    of its bilinear footprint that lies inside the map, so that none is clamped to the border.
    """

    def __init__(self, neighborhood: int):
        super().__init__()
        self.reach = neighborhood // 2
        self.log_sigma = nn.Parameter(torch.zeros(()))
        """Logarithm of the fall-off, in cells: one cell at first."""

    def weights(self) -> tuple[Float[Tensor, "K K"], Float[Tensor, "K K"]]:
        """The weights w = exp(-d / sigma), not yet normalised over the samples that count, and dw / d log sigma."""
        offset = torch.arange(-self.reach, self.reach + 1, dtype=self.log_sigma.dtype, device=self.log_sigma.device)
        with torch.no_grad():
            distance = torch.hypot(offset[:, None], offset) / self.log_sigma.exp()
            weights = torch.exp(-distance)
        return weights, weights * distance

    def forward(self, planes: Float[Tensor, "B C H W"], uv: Float[Tensor, "B P 2"]) -> Float[Tensor, "B P C"]:
        """Point-aligned features at `uv` (edges at 0 and 1), which lie inside the image."""
        batch, channels, height, width = planes.shape
        border = self.reach + 1
        kernel, slope = (w[None, None].to(planes.dtype) for w in self.weights())
        learning = torch.is_grad_enabled() and self.log_sigma.requires_grad

        def spread(single: Tensor) -> Tensor:  # one cell wider on every side than the map, for points on its edge
            padded = pad(single, (border,) * 4)
            total = conv2d(padded, kernel)
            if learning:  # its one weight's gradient is a second convolution; asked of the first it takes 20 times that
                total = total + (self.log_sigma - self.log_sigma.detach()) * conv2d(padded.detach(), slope)
            return total

        total = spread(planes.reshape(batch * channels, 1, height, width))
        total = total.reshape(batch, channels, *total.shape[2:])
        count = spread(planes.new_ones(1, 1, height, width)).expand(batch, -1, -1, -1)
        inner = torch.stack(
            [(part * n + 1) / (n + 2) for part, n in zip(uv.unbind(-1), (width, height), strict=True)], -1
        )
        return sample(total, inner) / sample(count, inner).clamp_min(1e-6)


class PointFeatures(nn.Module):
    """Point-aligned features (equations 1 and 2), projected to the width of tokens; 0 outside the frame.

    Of a full-resolution map, where there is one, the single sample at the projection joins them: a neighbourhood would
    blur the detail that it is there for.
    """

    def __init__(self, aligned: int, fine: int, width: int, neighborhood: int):
        super().__init__()
        self.aggregate = Aggregation(neighborhood)
        self.project = nn.Linear(aligned + fine, width)

    def forward(
        self, features: ImageFeatures, uv: Float[Tensor, "B P 2"], inside: Bool[Tensor, "B P"]
    ) -> Float[Tensor, "B P C"]:
        """Read the maps at `uv`."""
        read = self.aggregate(features.aligned, uv)
        if features.fine is not None:
            read = torch.cat([read, sample(features.fine, uv).to(read.dtype)], dim=-1)
        return self.project(read) * inside[..., None]


def color_difference(observation: Observation, mean: MeanHand) -> Float[Tensor, "B V 3"]:
    """How the photo differs from the mean colours at each vertex, in logits; 0 where it does not show the vertex."""
    difference = torch.logit(observation.colors, COLOR_MARGIN) - torch.logit(mean.colors, COLOR_MARGIN)
    return difference * observation.confidence[..., None]


class PointEvidence(nn.Module):
    """Tell a point what the photo shows of it: its aligned feature times its visibility, and how far off the mean.

    Beside that, its mean colour and its visibility: what the heads' changes start from. Not in the paper, where a point
    learns of the photo through a few hundred tokens only; with little training that road is long.
    """

    def __init__(self, width: int):
        super().__init__()
        self.seen = nn.Linear(width, width)
        self.known = nn.Linear(8, width)

    def forward(
        self, aligned: Float[Tensor, "B V C"], seen: Float[Tensor, "B V 3"], observation: Observation, mean: MeanHand
    ) -> Float[Tensor, "B V C"]:
        """To be added to the geometric tokens; `seen` is what `color_difference` says."""
        base = torch.logit(mean.colors, COLOR_MARGIN)
        known = torch.cat([base, seen, observation.visibility[..., None], observation.confidence[..., None]], dim=-1)
        return self.seen(aligned * observation.visibility[..., None]) + self.known(known)


POSITION_FREQUENCIES = 6
"""Octaves of the encoding of places in the image: down to a 64th of it."""


class VisualTokens(NamedTuple):
    """Visual evidence tokens and where in the image their evidence lies."""

    tokens: Float[Tensor, "B N C"]
    centers: Float[Tensor, "B N 2"]
    """Attention-weighted mean of the projections, the image's corners at 0 and 1."""


class PositionEncoding(nn.Module):
    """The encoding of places in the image as a token (P_VET)."""

    def __init__(self, width: int):
        super().__init__()
        self.project = nn.Linear(4 * POSITION_FREQUENCIES, width)

    def forward(self, uv: Float[Tensor, "B N 2"]) -> Float[Tensor, "B N C"]:
        """Tokens of places with the image's corners at 0 and 1."""
        return self.project(encode(2 * uv - 1, POSITION_FREQUENCIES))


class Tokenizer(nn.Module):
    """Learned queries read the point-aligned features, then exchange what they found, then a feed-forward network.

    The cross-attention has learned projections, or is equation 3 as printed (`literal`): one head, and the features
    themselves as keys and values. Points outside the frame are not read.
    """

    def __init__(self, width: int, heads: int, n_tokens: int, literal: bool):
        super().__init__()
        self.heads, self.literal = heads, literal
        self.queries = nn.Parameter(torch.randn(n_tokens, width))
        if not literal:
            self.query_norm, self.feature_norm = nn.LayerNorm(width), nn.LayerNorm(width)
            self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
            self.output = nn.Linear(width, width)
        self.attention, self.feed_forward = SelfAttention(width, heads), FeedForward(width)

    def forward(
        self,
        features: Float[Tensor, "B P C"],
        key_offsets: Float[Tensor, "B P C"] | None,
        uv: Float[Tensor, "B P 2"],
        inside: Bool[Tensor, "B P"],
    ) -> VisualTokens:
        """Tokens of the point-aligned `features`; `key_offsets` are added to what keys are made of, not to values."""
        queries = self.queries.expand(len(features), -1, -1)
        row = queries.new_ones(queries.shape[:2])
        column = torch.where(inside, 0.0, MASKED_LOGIT)
        if self.literal:
            q, k, v = queries, features if key_offsets is None else features + key_offsets, features
            q, k, v = q[:, None], k[:, None], v[:, None]
        else:
            normed = self.feature_norm(features)
            named = normed if key_offsets is None else normed + key_offsets
            q, k, v = self.query(self.query_norm(queries)), self.key(named), self.value(normed)
            q, k, v = (split_heads(part, self.heads) for part in (q, k, v))
        read, centers = attend(q, k, v, row, column, uv)
        assert centers is not None
        read = join_heads(read)
        tokens = read if self.literal else queries + self.output(read)
        tokens = tokens + self.attention(tokens)
        return VisualTokens(tokens + self.feed_forward(tokens), centers)


def grid_positions(height: int, width: int, like: Tensor) -> Float[Tensor, "N 2"]:
    """Centres of the cells of a map, row by row, its corners at 0 and 1."""
    x = (torch.arange(width, dtype=like.dtype, device=like.device) + 0.5) / width
    y = (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5) / height
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)
