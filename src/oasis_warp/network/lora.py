"""LoRA on the Gaussian heads of one guess (Hu et al. 2022; the paper's appendix B.3), for the colours they put out.

All of a head that stays as it is is computed once: features, their norm, and the first layer's output. Only outputs
that colours are made of are kept, so geometry cannot change.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import gelu, linear

from oasis_warp.network.heads import GaussianHead, decode_colors

COLOR_OUTPUTS = ("colors", "trust")
"""Of a head, where it has them."""


class HeadCache(NamedTuple):
    """One frozen head, and what it is asked: a row for each Gaussian."""

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
"""Of the vertices' Gaussians, then of the faces' where these have a head: all of a guess, in its order."""

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
        rows: Whose colour each Gaussian has.
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


def zero_updates(cache: HeadCache, rank: int, random: torch.Generator) -> LowRank:
    """Updates of the three layers that change nothing yet: A uniform up to 1 / sqrt(inputs), B zero.

    Args:
        cache: Of the head.
        rank: Of B A.
        random: On the CPU, so that every device starts alike.
    """
    hidden = cache.first.shape[1]
    sizes = (cache.inputs.shape[1], hidden), (hidden, hidden), (hidden, len(cache.last[1]))
    updates = []
    for inputs, outputs in sizes:
        down = (2 * torch.rand(rank, inputs, generator=random) - 1) / math.sqrt(inputs)
        updates.append((down.to(cache.first).requires_grad_(), cache.first.new_zeros(rank, outputs).requires_grad_()))
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
