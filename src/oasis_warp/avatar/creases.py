"""Creases of a palm that the photo shows go flat where a pose stretches skin, and compressed skin has wrinkles.

A bent thumb bunches the skin of its ball, and bent fingers fold the palm. Kept on an open hand, these lumps looked like
scars. A fist that was made of an open hand had none, and looked like rubber.
"""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from oasis_warp.avatar.anchors import gaussian_corners, vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.avatar.folds import LEAST, MIN_COLOR, Folds, beyond_shallow, edges_among, ink_share, rows_of
from oasis_warp.avatar.sky import sky_mesh
from oasis_warp.avatar.wrinkles import wrinkle_logs
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.ops.corner_reading import Corners, read_corners

PASSES = 60
"""Smoothings over the mesh that leave a palm without its creases, about 15 mm."""
AS_IN_PHOTO, STRETCHED = 0.05, 0.25
"""Logarithms of the growth of areas since the photo up to which creases stay and from which they are flat."""
LITTLE, COMPRESSED = 0.25, 0.85
"""Logarithms by which areas shrink, up to which skin stays smooth and from which its wrinkles are deepest."""
SHALLOW = 0.17
"""Logarithm of colours that deep creases tend to. Crisp palm lines, which are no deeper, stay: graders missed them."""

LEAST_AREA = 1e-12
"""Least area of which a logarithm is taken [m^2]."""
LEAST_WRINKLE = 0.004
"""Least logarithm of a wrinkle: a byte of a colour."""


class Creases(NamedTuple):
    """Creases and wrinkles at M of an avatar's Gaussians, none of which has folds."""

    index: Int[Tensor, "M"]
    """Their numbers among all."""
    row: Int[Tensor, "N"]
    """Place of each Gaussian in `index`, -1 for none; int32."""
    corners: Corners
    """Vertices around each."""
    change: Float[Tensor, "M 3"]
    """Added to the logarithms of their colours where skin is wholly stretched."""
    wrinkles: Float[Tensor, "M 3"]
    """The same where it is wholly compressed."""
    areas: Float[Tensor, "C"]
    """Areas around the vertices of `sky.sky_mesh` [m^2], in the photo; of the open hand where skin is painted."""


@torch.no_grad()
def find_creases(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    invented: Float[Tensor, "V"] | None,
    photo: Float[Tensor, "V 3"],
    flat: Float[Tensor, "V 3"],
    folds: Folds,
) -> Creases:
    """Creases of the palm as far as the photo shows it, ink is none; and wrinkles.

    Args:
        hand: Model of the surface.
        gaussians: Canonical.
        invented: Share of each vertex that is painted.
        photo: Vertices in the photo [m].
        flat: Vertices of the open hand [m].
        folds: Those of the same avatar.
    """
    vertex, edges, palm = _palm_skin(hand)
    logs = vertex_colors(gaussians, len(hand.template)).clamp_min(MIN_COLOR).log()
    own, palm = logs[vertex], palm[:, None].to(logs)
    around = surface.smooth_over_mesh(torch.cat([own * palm, palm], 1), edges, PASSES)
    around = around[:, :3] / around[:, 3:]
    seen = palm if invented is None else palm * (1 - invented[vertex, None].to(palm))
    fields = torch.cat([around, seen * (1 - ink_share(own - around, edges))], 1)
    beside = torch.cat([logs, torch.zeros_like(logs[:, :1])], 1)  # read by Gaussians at the palm's border
    read = vertex_to_gaussians(beside.index_copy(0, vertex, fields), hand.faces, gaussians)
    wrinkles = wrinkle_logs(hand, gaussians)
    some = (read[:, 3] > LEAST) | (wrinkles[:, 1].abs() > LEAST_WRINKLE)
    index = torch.nonzero(some.index_fill(0, folds.index, False))[:, 0]
    beyond = gaussians.colors[index].clamp_min(MIN_COLOR).log() - read[index, :3]
    corners = Corners(*(part[index] for part in gaussian_corners(hand.faces, gaussians)))
    change = -beyond_shallow(beyond, SHALLOW) * read[index, 3:]
    areas = _coarse_areas(torch.stack([photo, flat])).log()
    painted = areas.new_zeros(()) if invented is None else invented[sky_mesh(areas.device).vertices].to(areas)
    areas = torch.lerp(*areas, painted).exp()
    return Creases(index, rows_of(index, len(read)), corners, change, wrinkles[index], areas)


@functools.lru_cache(4)
@torch.inference_mode(False)
def _palm_skin(hand: HandModel) -> tuple[Int[Tensor, "S"], Int[Tensor, "E 2"], Float[Tensor, "S"]]:
    """Vertices of palms, edges between them by their places among these, and the share of palm of each."""
    palm = skin_regions(hand).palm * (1 - hand.nail.clamp(0, 1))
    vertex = torch.nonzero(palm > LEAST)[:, 0]
    return vertex, edges_among(hand, vertex), palm[vertex]


@torch.no_grad()
def crease_logs(creases: Creases, posed: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B M 3"]:
    """What a posed surface [m] adds to the logarithms of the colours of creases."""
    share = read_corners(stretched_share(creases, posed)[..., None], creases.corners)
    return share.clamp_min(0) * creases.change - share.clamp_max(0) * creases.wrinkles


@torch.no_grad()
def stretched_share(creases: Creases, posed: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B V"]:
    """How flat creases are at the vertices of a posed surface [m], 0 to 1; how deep wrinkles are, 0 to -1."""
    mesh = sky_mesh(posed.device)
    grown = (_coarse_areas(posed) / creases.areas).log()
    grown = read_corners(grown[..., None], mesh.corners)[..., 0]
    flat = ((grown - AS_IN_PHOTO) / (STRETCHED - AS_IN_PHOTO)).clamp(0, 1)
    return flat - ((-grown - LITTLE) / (COMPRESSED - LITTLE)).clamp(0, 1)


def _coarse_areas(vertices: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B C"]:
    """Areas of the faces around each vertex of `sky.sky_mesh`."""
    mesh = sky_mesh(vertices.device)
    a, b, c = vertices[..., mesh.vertices, :][..., mesh.faces, :].unbind(-2)
    areas = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    return pad(areas, (0, 1))[..., mesh.vertex_faces].sum(-1).clamp_min(LEAST_AREA)  # a zero past the last face
