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
    nearest = torch.full((len(places),), float("inf"), dtype=places.dtype)
    chosen = [0]
    for _ in range(count - 1):
        nearest = torch.minimum(nearest, (places - places[chosen[-1]]).square().sum(1))
        chosen.append(int(nearest.argmax()))
    index = torch.tensor(chosen)
    distance = torch.cdist(places, places[index])
    near, blend = distance.topk(BLENDED, dim=1, largest=False)
    weights = 1 / (near / near.mean() + 1e-3).square()
    pool = distance.T.topk(POOLED, dim=1, largest=False).indices
    return CoarsePoints(index, pool, blend, (weights / weights.sum(1, keepdim=True)).float())


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
