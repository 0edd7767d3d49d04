"""Visibility-conditioned point-image attention (equations 5 and 6), and the joint attention that ablates it."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from oasis_warp.network.attention import AdaptiveNorm, FeedForward, attend, join_heads, split_heads


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
