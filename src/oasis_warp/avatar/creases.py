"""Creases of a palm that the photo shows go flat where a pose stretches their skin.

A bent thumb bunches the skin of its ball, and bent fingers fold the palm. Kept on an open hand, these lumps looked like
scars.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.avatar.folds import LEAST, MIN_COLOR, Folds, beyond_shallow
from oasis_warp.avatar.sky import sky_mesh
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians

PASSES = 60
"""Smoothings over the mesh that leave a palm without its creases, about 15 mm."""
AS_IN_PHOTO, STRETCHED = 0.05, 0.25
"""Logarithms of the growth of areas since the photo up to which creases stay and from which they are flat."""
SHALLOW = 0.17
"""Logarithm of colours that deep creases tend to. Crisp palm lines, which are no deeper, stay: graders missed them."""
LEAST_SHARE = 1e-4
"""Weight of skin of the back where a palm is smoothed."""


class Creases(NamedTuple):
    """Creases at M of an avatar's Gaussians, none of which has folds."""

    index: Int[Tensor, "M"]
    """Their numbers among all."""
    change: Float[Tensor, "M 3"]
    """Added to the logarithms of their colours where skin is wholly stretched."""
    areas: Float[Tensor, "C"]
    """Areas around the vertices of `sky.sky_mesh` in the photo [m^2]."""


@torch.no_grad()
def find_creases(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    invented: Float[Tensor, "V"] | None,
    photo: Float[Tensor, "V 3"],
    folds: Folds,
) -> Creases:
    """Creases of the palm as far as the photo shows it.

    Args:
        hand: Model of the surface.
        gaussians: Canonical.
        invented: Share of each vertex that is painted.
        photo: Vertices in the photo [m].
        folds: Those of the same avatar.
    """
    logs = vertex_colors(gaussians, len(hand.template)).clamp_min(MIN_COLOR).log()
    palm = (skin_regions(hand).palm * (1 - hand.nail.clamp(0, 1)))[:, None].to(logs)
    weights = palm.clamp_min(LEAST_SHARE)
    edges = surface.mesh_edges(hand.faces)
    around = surface.smooth_over_mesh(torch.cat([logs * weights, weights], 1), edges, PASSES)
    seen = palm if invented is None else palm * (1 - invented[:, None].to(palm))
    read = vertex_to_gaussians(torch.cat([around[:, :3] / around[:, 3:], seen], 1), hand.faces, gaussians)
    share = read[:, 3].index_fill(0, folds.index, 0)
    index = torch.nonzero(share > LEAST)[:, 0]
    beyond = gaussians.colors[index].clamp_min(MIN_COLOR).log() - read[index, :3]
    return Creases(index, -beyond_shallow(beyond, SHALLOW) * share[index, None], _coarse_areas(photo))


@torch.no_grad()
def flat_share(creases: Creases, posed: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B V"]:
    """How flat creases are at the vertices of a posed surface [m], 0 to 1."""
    mesh = sky_mesh(posed.device)
    grown = (_coarse_areas(posed) / creases.areas).log()
    grown = (grown[..., mesh.corners] * mesh.weights.to(grown)).sum(-1)
    return ((grown - AS_IN_PHOTO) / (STRETCHED - AS_IN_PHOTO)).clamp(0, 1)


def _coarse_areas(vertices: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B C"]:
    """Areas of the faces around each vertex of `sky.sky_mesh`."""
    mesh = sky_mesh(vertices.device)
    a, b, c = vertices[..., mesh.vertices, :][..., mesh.faces, :].unbind(-2)
    areas = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    return pad(areas, (0, 1))[..., mesh.vertex_faces].sum(-1)  # a zero past the last face
