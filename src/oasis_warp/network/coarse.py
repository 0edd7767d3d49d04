"""A coarse set of points on the surface, and the way from all vertices to it and back."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel

LENGTH = 0.01
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
    places = torch.cat([hand.template.double() / LENGTH, normals, hand.weights.double()], dim=1)
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
