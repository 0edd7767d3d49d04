"""Fewer Gaussians where little is to be seen: one a vertex, none a face."""

from oasis_warp.avatar.anchors import place_anchors
from oasis_warp.avatar.densify import read_at
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, PosedHand

SPREAD = 1.6
"""Standard deviations along the surface over those of a vertex Gaussian that has face Gaussians beside it. With 1.3 a
lattice of gaps shows where the surface is drawn out; thicker ones make fingers fatter."""


def coarsen(hand: HandModel, gaussians: CanonicalGaussians, rest: PosedHand) -> CanonicalGaussians:
    """A third of the Gaussians: wider ones on the vertices alone, in the colours that all have there together.

    Args:
        hand: Whose surface it is.
        gaussians: Of vertices and faces, on `rest`, without shade.
        rest: The surface at rest.
    """
    anchors = place_anchors(hand, rest)
    index, n = anchors.vertex_index, len(anchors.vertex_index)
    faces = hand.faces.to(index.device)
    colors = read_at(gaussians, gaussians.colors, rest.vertices, faces, rest.vertices[index])
    return CanonicalGaussians(
        index,
        rest.vertices.new_zeros(n, 3),
        anchors.face_index[:0],
        anchors.barycentrics[:0],
        anchors.quats[:n],
        anchors.scales[:n] * rest.vertices.new_tensor([SPREAD, SPREAD, 1.0]),
        anchors.opacities[:n],
        colors,
    )
