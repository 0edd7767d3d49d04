"""Skin as fine as a fist that fills the picture needs."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.albedo_split import seen_around
from oasis_warp.adaptation.photo_view import keep_pictures
from oasis_warp.avatar.densify import SKIN, densify, parts_for_spacing
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop

SPACING, COARSE = 0.55e-3, 2e-3
"""Side of the squares that are as large as the parts of faces are at most [m]: 2 to 3 px of a fist that fills 512 px.
And the same where pictures of 256 px of an open hand are all that is wanted: faces stay whole."""


@torch.no_grad()
def cut_skin(
    hand: HandModel, gaussians: CanonicalGaussians, crops: Sequence[HandCrop], seen: Float[Tensor, "V"],
    spacing: float = SPACING,
) -> CanonicalGaussians:
    """Cut faces into parts with thin, opaque Gaussians, which show the photos' cameras what they saw before.

    In a fist that fills the picture, skin with one Gaussian a face looks like wax. The parts that show a photo's detail
    were thick and half transparent for their fit; turned, they had blurred outlines. Vertices without faces stay.

    Args:
        hand: Model of the surface.
        gaussians: Fitted to the photos, with the same number of parts along each edge of a face.
        crops: K photos, with one surface at rest.
        seen: How well they show the skin of each vertex, 0 to 1.
        spacing: Side of the squares that are as large as the parts are at most [m].
    """
    rest = crops[0].rest.vertices
    faces = hand.faces.to(rest.device)
    there = torch.bincount(gaussians.face_index, minlength=len(faces)).double().sqrt().round().long()
    parts = torch.where(there > 0, torch.maximum(there, parts_for_spacing(rest, faces, spacing)), 1)
    cut = densify(gaussians, rest, faces, parts, SKIN)
    openly = seen_around(seen, surface.mesh_edges(faces))
    return keep_pictures(hand, gaussians, cut, crops, openly) if cut.n_new else gaussians
