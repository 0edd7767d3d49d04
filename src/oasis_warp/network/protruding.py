"""Vertex Gaussians that stick out of the skin: a trained network leaves some, which shimmer between the fingers."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.core import rotation, surface
from oasis_warp.core.types import CanonicalGaussians

REACH = 2.0
"""Standard deviations from its middle to where a Gaussian is still seen."""
HEIGHT = 0.0015
"""Above the skin, up to which it may reach there; at twice of it nothing is left of it [m]."""
ROWS = 4096
"""Of points whose distances to all vertices are held at once."""


def fade_protruding(
    gaussians: CanonicalGaussians, rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> CanonicalGaussians:
    """The same with vertex Gaussians fainter the further they reach above the skin at rest.

    A disc on a finger leaves the skin on both sides, and one that was shifted along it may stand in the air. What a
    Gaussian reaches is the ends of its two longer axes; how far that is above the skin, by the nearest vertex.
    """
    count = len(gaussians.vertex_index)
    middles = rest[gaussians.vertex_index] + gaussians.offsets
    scales = gaussians.scales[:count]
    longer = scales.argsort(1)[:, None, 1:].expand(-1, 3, -1)
    axes = (rotation.to_matrix(gaussians.quats[:count]) * scales[:, None]).gather(2, longer)
    ends = torch.cat([middles[..., None] + REACH * axes, middles[..., None] - REACH * axes], 2).movedim(2, 0)
    normals = surface.vertex_normals(rest, faces)
    near = nearest(ends.flatten(0, 1), rest)
    height = ((ends.flatten(0, 1) - rest[near]) * normals[near]).sum(1).view(len(ends), -1).amax(0)
    opacities = gaussians.opacities.clone()
    opacities[:count] *= (2 - height / HEIGHT).clamp(0, 1)
    return gaussians._replace(opacities=opacities)


def nearest(points: Float[Tensor, "N 3"], vertices: Float[Tensor, "V 3"]) -> Int[Tensor, "N"]:
    """The nearest vertex of each point: by a tree on the CPU, on a GPU by trying all."""
    if points.device.type == "cpu":
        return torch.from_numpy(cKDTree(vertices.detach().numpy()).query(points.detach().numpy())[1])
    return torch.cat([torch.cdist(rows, vertices).argmin(1) for rows in points.split(ROWS)])
