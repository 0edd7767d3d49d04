"""Attention, adaptive layer norm and the blocks built from them."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import gelu, scaled_dot_product_attention

SPARE = 8
"""Dimensions that a biased attention adds to its heads; flash kernels want multiples of 8."""
NEVER = -(2.0**14)
"""Added to the logit of a key that must not be read; exact in bfloat16."""


def attend(
    queries: Float[Tensor, "B h L D"],
    keys: Float[Tensor, "B h S D"],
    values: Float[Tensor, "B h S D"],
    row: Float[Tensor, "B L"],
    column: Float[Tensor, "B S"],
    carried: Float[Tensor, "B S E"] | None = None,
) -> tuple[Float[Tensor, "B h L D"], Float[Tensor, "B L E"] | None]:
    """softmax(Q K^T / sqrt(D) + row column^T) V, and the mean over the heads of the same softmax times `carried`.

    The rank-one bias rides in spare dimensions of the queries and keys and `carried` in those of the values, so that
    no mask of L x S exists and every fused kernel serves. Where inputs are rounded to bfloat16, the bias keeps 16 bits:
    it is split in two, and the kernels add the products up in float32. `column` must be exact in bfloat16.
    """
    heads, dimension = queries.shape[1], queries.shape[-1]
    scaled = row.float() * math.sqrt(dimension)
    high = scaled.detach().bfloat16().float()
    left = torch.stack([high, scaled - high], dim=-1)
    right = torch.stack([column, column], dim=-1)

    def widen(tensor: Tensor, spare: Tensor | None) -> Tensor:
        if spare is None:
            return torch.nn.functional.pad(tensor, (0, SPARE))
        filled = torch.nn.functional.pad(spare.to(tensor.dtype), (0, SPARE - spare.shape[-1]))
        return torch.cat([tensor, filled[:, None].expand(-1, heads, -1, -1)], dim=-1)

    mixed = scaled_dot_product_attention(
        widen(queries, left), widen(keys, right), widen(values, carried), scale=1 / math.sqrt(dimension)
    )
    if carried is None:
        return mixed[..., :dimension], None
    return mixed[..., :dimension], mixed[..., dimension : dimension + carried.shape[-1]].mean(1)


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
