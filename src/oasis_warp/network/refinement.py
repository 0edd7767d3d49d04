"""Self-attention among the points, all of them or a coarse set of them."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.network.attention import Block

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
        ValueError: more points than vertices.
    """
    if count > len(hand.template):
        raise ValueError(f"n_coarse: expected at most {len(hand.template)}, the vertices of the hand, got {count}.")
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
    """The way of point features to a coarse set of points and back; no parameters, and nothing that is saved."""

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
