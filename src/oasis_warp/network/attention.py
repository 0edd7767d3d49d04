"""Attention, adaptive layer norm, and visibility-conditioned point-image attention (equations 5 and 6).

The points also attend to each other, all of them or a coarse set of them.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import gelu, scaled_dot_product_attention

from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel

BIAS_DIMENSIONS = 8
"""Dimensions that a biased attention adds to its heads; flash kernels want multiples of 8."""
MASKED_LOGIT = -(2.0**14)
"""Added to the logit of a key that must not be read; exact in bfloat16."""


def attend(
    queries: Float[Tensor, "B h L D"],
    keys: Float[Tensor, "B h S D"],
    values: Float[Tensor, "B h S D"],
    row: Float[Tensor, "B L"],
    column: Float[Tensor, "B S"],
    extra: Float[Tensor, "B S E"] | None = None,
) -> tuple[Float[Tensor, "B h L D"], Float[Tensor, "B L E"] | None]:
    """softmax(Q K^T / sqrt(D) + row column^T) V, and the mean over the heads of the same softmax times `extra`.

    The rank-one bias is stored in spare dimensions of the queries and keys and `extra` in those of the values, so that
    no mask of L x S exists and every fused kernel serves. Where inputs are rounded to bfloat16, the bias keeps 16 bits:
    it is split in two, and the kernels add the products up in float32. `column` must be exact in bfloat16.
    """
    heads, dimension = queries.shape[1], queries.shape[-1]
    scaled = row.float() * math.sqrt(dimension)
    high = scaled.detach().bfloat16().float()
    left = torch.stack([high, scaled - high], dim=-1)
    right = torch.stack([column, column], dim=-1)

    def widen(tensor: Tensor, bias_features: Tensor | None) -> Tensor:
        if bias_features is None:
            return torch.nn.functional.pad(tensor, (0, BIAS_DIMENSIONS))
        filled = torch.nn.functional.pad(bias_features.to(tensor.dtype), (0, BIAS_DIMENSIONS - bias_features.shape[-1]))
        return torch.cat([tensor, filled[:, None].expand(-1, heads, -1, -1)], dim=-1)

    mixed = scaled_dot_product_attention(
        widen(queries, left), widen(keys, right), widen(values, extra), scale=1 / math.sqrt(dimension)
    )
    if extra is None:
        return mixed[..., :dimension], None
    return mixed[..., :dimension], mixed[..., dimension : dimension + extra.shape[-1]].mean(1)


def split_heads(x: Float[Tensor, "B N C"], heads: int) -> Float[Tensor, "B h N D"]:
    """Channels as heads of equal size."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def join_heads(x: Float[Tensor, "B h N D"]) -> Float[Tensor, "B N C"]:
    """The inverse of `split_heads`."""
    return x.transpose(1, 2).flatten(2)


class AdaptiveNorm(nn.Module):
    """Layer norm whose shift and scale, and a gate for what follows, come from a context (AdaLN; Peebles and Xie 2023).

    At first the norm is plain and the gate open.
    """

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.modulation = nn.Linear(width, 3 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(
        self, x: Float[Tensor, "B N C"], context: Float[Tensor, "B C"]
    ) -> tuple[Float[Tensor, "B N C"], Float[Tensor, "B 1 C"]]:
        """The modulated tokens, and the gate."""
        shift, scale, gate = self.modulation(nn.functional.silu(context))[:, None].chunk(3, dim=-1)
        return self.norm(x) * (1 + scale) + shift, 1 + gate


class FeedForward(nn.Sequential):
    """Layer norm and a two-layer perceptron; the caller adds the residual."""

    def __init__(self, width: int, expansion: int = 4):
        super().__init__(
            nn.LayerNorm(width), nn.Linear(width, expansion * width), nn.GELU(), nn.Linear(expansion * width, width)
        )


class SelfAttention(nn.Module):
    """Layer norm and multi-head self-attention; the caller adds the residual."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.inputs, self.output = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "B N C"]) -> Float[Tensor, "B N C"]:
        """What each token reads from all."""
        q, k, v = (split_heads(part, self.heads) for part in self.inputs(self.norm(x)).chunk(3, dim=-1))
        return self.output(join_heads(scaled_dot_product_attention(q, k, v)))


class Block(nn.Module):
    """Self-attention, then a feed-forward network, each with its residual."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.attention, self.feed_forward = SelfAttention(width, heads), FeedForward(width)

    def forward(self, x: Float[Tensor, "B N C"]) -> Float[Tensor, "B N C"]:
        """Refined tokens."""
        x = x + self.attention(x)
        return x + self.feed_forward(x)


class Perceptron(nn.Module):
    """Two layers with a GELU between."""

    def __init__(self, inputs: int, hidden: int, outputs: int):
        super().__init__()
        self.first, self.second = nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)

    def forward(self, x: Float[Tensor, "*batch I"]) -> Float[Tensor, "*batch O"]:
        """Layer by layer."""
        return self.second(gelu(self.first(x)))


class VisibilityAttention(nn.Module):
    """Every point reads image tokens: a visible one the local tokens, a hidden one rather the global token.

    Adding a constant to all logits of a row changes nothing, so that only the sum of the paper's two strengths acts:
    there is one, `beta`, of which local tokens get +beta s / 2 and the global token -beta s / 2 for s = 2 p - 1. At
    first it is ln(N + 1): with equal affinities the global token takes half of a hidden point's attention against N
    local ones, and next to nothing of a visible point's.
    """

    def __init__(self, width: int, heads: int, n_tokens: int, biased: bool):
        super().__init__()
        self.heads = heads
        self.point_norm, self.token_norm = AdaptiveNorm(width), AdaptiveNorm(width)
        self.query, self.key_value = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, width)
        self.log_beta = nn.Parameter(torch.tensor(math.log(math.log(n_tokens + 1)))) if biased else None

    def forward(
        self,
        points: Float[Tensor, "B P C"],
        local: Float[Tensor, "B N C"],
        context: Float[Tensor, "B C"],
        visibility: Float[Tensor, "B P"],
    ) -> Float[Tensor, "B P C"]:
        """Occlusion-aware Gaussian features: `points` and what they read. `context` is the global token."""
        q, k, v, gate = self._project(points, local, context)
        row, column = self._bias(visibility, local.shape[1])
        read, _ = attend(q, k, v, row, column)
        return points + gate * self.output(join_heads(read))

    def global_share(
        self,
        points: Float[Tensor, "B P C"],
        local: Float[Tensor, "B N C"],
        context: Float[Tensor, "B C"],
        visibility: Float[Tensor, "B P"],
    ) -> Float[Tensor, "B P"]:
        """Attention that each point gives to the global token, mean of the heads: the paper's figure of VPIA."""
        q, k, _, _ = self._project(points, local, context)
        row, column = self._bias(visibility, local.shape[1])
        logits = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1]) + (row[:, :, None] * column[:, None])[:, None]
        return logits.softmax(-1)[..., -1].mean(1)

    def _project(self, points: Tensor, local: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        normed, gate = self.point_norm(points, context)
        tokens, token_gate = self.token_norm(local, context)
        everything = torch.cat([token_gate * tokens, context[:, None]], dim=1)
        k, v = self.key_value(everything).chunk(2, dim=-1)
        return split_heads(self.query(normed), self.heads), split_heads(k, self.heads), split_heads(v, self.heads), gate

    def _bias(self, visibility: Tensor, n_local: int) -> tuple[Tensor, Tensor]:
        strength = 0.0 if self.log_beta is None else self.log_beta.float().exp() / 2
        row = strength * (2 * visibility.float() - 1)
        column = row.new_ones(len(row), n_local + 1)
        column[:, -1] = -1
        return row, column


class JointAttention(nn.Module):
    """Points and image tokens attend to each other in one sequence, each kind with its own projections.

    The multimodal block of LHM (Qiu et al. 2025) that the paper puts in the place of VPIA; visibility plays no part.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norms = nn.ModuleList(AdaptiveNorm(width) for _ in range(2))
        self.inputs = nn.ModuleList(nn.Linear(width, 3 * width) for _ in range(2))
        self.output, self.feed_forward = nn.Linear(width, width), FeedForward(width)

    def forward(
        self, points: Float[Tensor, "B P C"], local: Float[Tensor, "B N C"], context: Float[Tensor, "B C"]
    ) -> Float[Tensor, "B P C"]:
        """The points after the block; the tokens have no further use."""
        parts, gates = [], []
        for x, norm, project in zip((points, local), self.norms, self.inputs, strict=True):
            normed, gate = norm(x, context)
            parts.append(project(normed))
            gates.append(gate)
        q, k, v = (split_heads(part, self.heads) for part in torch.cat(parts, dim=1).chunk(3, dim=-1))
        read = join_heads(scaled_dot_product_attention(q[:, :, : points.shape[1]], k, v))
        points = points + gates[0] * self.output(read)
        return points + self.feed_forward(points)


POINT_LENGTH = 0.01
"""Distance that counts as much as a right angle between normals, or as belonging to another bone [m]."""
POOLED, BLENDED = 16, 4
"""Vertices that a coarse point averages; coarse points that a vertex blends."""


class CoarsePoints(NamedTuple):
    """N of the V vertices, and how values travel between the two."""

    index: Int[Tensor, "N"]
    pool: Int[Tensor, "N 16"]
    """Vertices whose mean a coarse point takes, itself among them."""
    blend: Int[Tensor, "V 4"]
    """Coarse points that a vertex reads."""
    weights: Float[Tensor, "V 4"]
    """Their weights; rows sum to one."""


def place_coarse_points(hand: HandModel, count: int) -> CoarsePoints:
    """Spread `count` points over the surface, each as far as can be from those before it.

    Distance is measured in position, normal and skinning weights together, so that neither the other side of a finger
    nor the neighbouring finger is near.

    Raises:
        ValueError: more points than vertices, or fewer than a neighbourhood has.
    """
    if not POOLED <= count <= len(hand.template):
        raise ValueError(f"n_coarse: expected {POOLED} to {len(hand.template)}, the vertices of the hand, got {count}.")
    normals = surface.vertex_normals(hand.template.double(), hand.faces)
    places = torch.cat([hand.template.double() / POINT_LENGTH, normals, hand.weights.double()], dim=1)
    index, squared = _spread(places, count)
    near, blend = squared.T.topk(BLENDED, dim=1, largest=False)
    near = near.sqrt()
    weights = 1 / (near / near.mean() + 1e-3).square()
    pool = squared.topk(POOLED, dim=1, largest=False).indices
    return CoarsePoints(index, pool, blend, (weights / weights.sum(1, keepdim=True)).float())


def _spread(places: Float[Tensor, "V D"], count: int) -> tuple[Int[Tensor, "N"], Float[Tensor, "N V"]]:
    """Farthest-point sampling from place 0, and the squared distances of all places to those chosen.

    |a - b|^2 as |a|^2 - 2 a b + |b|^2: one product with a matrix for each point, as every network is built with this.
    """
    lengths = places.square().sum(1)
    index = torch.zeros(count, dtype=torch.int64)
    squared = places.new_empty(count, len(places))
    nearest = torch.full_like(lengths, float("inf"))
    for k in range(count):
        if k:
            index[k] = nearest.argmax()
        last = int(index[k])
        squared[k] = torch.addmv(lengths + lengths[last], places, places[last], alpha=-2).clamp_min(0)
        nearest = torch.minimum(nearest, squared[k])
    return index, squared


def to_coarse(values: Float[Tensor, "B V C"], pool: Int[Tensor, "N 16"]) -> Float[Tensor, "B N C"]:
    """Means round the coarse points."""
    return values.index_select(1, pool.flatten()).unflatten(1, pool.shape).mean(2)


def to_fine(
    values: Float[Tensor, "B N C"], blend: Int[Tensor, "V 4"], weights: Float[Tensor, "V 4"]
) -> Float[Tensor, "B V C"]:
    """Values of the coarse points, blended at all vertices."""
    parts = (
        values.index_select(1, column) * weight[:, None].to(values.dtype)
        for column, weight in zip(blend.unbind(1), weights.unbind(1), strict=True)
    )
    return sum(parts, start=values.new_zeros(()))


class CoarseLevel(nn.Module):
    """Down- and upsampling of point features to a coarse set of points; without parameters or saved buffers."""

    pool: Tensor
    blend: Tensor
    weights: Tensor

    def __init__(self, hand: HandModel, count: int):
        super().__init__()
        for name, tensor in place_coarse_points(hand, count)._asdict().items():
            self.register_buffer(name, tensor, persistent=False)

    def down(self, x: Float[Tensor, "B V C"]) -> Float[Tensor, "B N C"]:
        """Means round the coarse points."""
        return to_coarse(x, self.pool)

    def up(self, x: Float[Tensor, "B N C"]) -> Float[Tensor, "B V C"]:
        """Blends of the coarse points."""
        return to_fine(x, self.blend, self.weights)


class Refinement(nn.Module):
    """Blocks of self-attention over Gaussian features.

    On a coarse level the points take over how much their coarse neighbours changed, so that what tells them apart
    stays.
    """

    def __init__(self, width: int, heads: int, layers: int):
        super().__init__()
        self.blocks = nn.Sequential(*(Block(width, heads) for _ in range(layers)))

    def forward(self, x: Float[Tensor, "B V C"], level: CoarseLevel | None) -> Float[Tensor, "B V C"]:
        """Refined features; at all points where `level` is None."""
        if level is None:
            return self.blocks(x)
        coarse = level.down(x)
        return x + level.up(self.blocks(coarse) - coarse)
