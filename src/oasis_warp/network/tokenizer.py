"""Learnable tokenization: thousands of point-aligned features become a few visual evidence tokens (equation 3)."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from oasis_warp.network.attention import NEVER, FeedForward, SelfAttention, attend, join_heads, split_heads
from oasis_warp.network.encoding import encode

POSITION_FREQUENCIES = 6
"""Octaves of the encoding of places in the image: down to a 64th of it."""


class VisualTokens(NamedTuple):
    """Visual evidence tokens and where in the image their evidence lies."""

    tokens: Float[Tensor, "B N C"]
    centers: Float[Tensor, "B N 2"]
    """Attention-weighted mean of the projections, the image's corners at 0 and 1."""


class PlaceEncoding(nn.Module):
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
        column = torch.where(inside, 0.0, NEVER)
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


def grid_places(height: int, width: int, like: Tensor) -> Float[Tensor, "N 2"]:
    """Centres of the cells of a map, row by row, its corners at 0 and 1."""
    x = (torch.arange(width, dtype=like.dtype, device=like.device) + 0.5) / width
    y = (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5) / height
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)


