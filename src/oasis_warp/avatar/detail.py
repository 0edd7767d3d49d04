"""Give a prior's guess Gaussians fine enough for the detail of a photo."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, PosedHand

DETAIL_OPACITY, DETAIL_SPREAD = 0.9, 0.5
"""Of a face Gaussian that carries detail, over those of an anchor: of five pairs tried on photos and synthetic hands
the one that came nearest to the photos. Half the opacity would keep half a decibel more of the learned outline in other
poses and lose as much of the photo."""


def carry_detail(hand: HandModel, guess: CanonicalGaussians, rest: PosedHand) -> CanonicalGaussians:
    """`guess` with a Gaussian on every face that is opaque enough to show what the photo shows there.

    A trained network draws smooth skin with large Gaussians on vertices and lets those on faces nearly vanish. Texture
    learning changes colours only, so it would find nothing to paint small details on. A face whose Gaussian is missing
    or fainter than detail needs gets a small one of the surface's own shape, in the colours of its corners. A guess
    whose faces are opaque, as the mean prior's, is returned as it is.
    """
    anchors = place_anchors(hand, rest)
    n_points, faces, index = len(guess.vertex_index), hand.faces.to(rest.vertices.device), anchors.face_index
    place = torch.full((len(faces),), -1, device=faces.device)
    place[guess.face_index] = torch.arange(n_points, len(guess.opacities), device=faces.device)
    place = place[index]
    wanted = DETAIL_OPACITY * anchors.opacities[len(anchors.vertex_index) :]
    kept = (place >= 0) & (guess.opacities[place] >= wanted)
    if bool(kept.all()):
        return guess
    fine = anchors.with_colors(vertex_to_gaussians(_vertex_colors(guess, len(rest.vertices)), faces, anchors))

    def on_faces(own: Tensor, small: Tensor) -> Tensor:
        chosen = torch.where(kept.view(-1, *[1] * (own.ndim - 1)), own[place], small[-len(index) :])
        return torch.cat([own[:n_points], chosen])

    centers = torch.cat([fine.barycentrics.new_zeros(n_points, 3), guess.barycentrics])
    return CanonicalGaussians(
        vertex_index=guess.vertex_index,
        offsets=guess.offsets,
        face_index=index,
        barycentrics=on_faces(centers, fine.barycentrics)[n_points:],
        quats=on_faces(guess.quats, fine.quats),
        scales=on_faces(guess.scales, DETAIL_SPREAD * fine.scales),
        opacities=on_faces(guess.opacities, DETAIL_OPACITY * fine.opacities),
        colors=on_faces(guess.colors, fine.colors),
    )


def _vertex_colors(guess: CanonicalGaussians, n_vertices: int) -> Float[Tensor, "V 3"]:
    """Of the vertices' own Gaussians; the mean of all where a vertex has none, next to the wrist's end."""
    own = guess.colors[: len(guess.vertex_index)]
    colors = own.mean(0).repeat(n_vertices, 1)
    colors[guess.vertex_index] = own
    return colors
