"""Folds over the joints of fingers, which open when the finger bends.

Skin over a straight joint lies in folds and is darker; over a bent one it is stretched, smooth and paler. The colours
of an avatar are those of one state: painted skin is that of straight fingers, seen skin that of the photo. The skin of
folds is darker than that around the joint. This difference, without fine lines, goes as the joint bends further.
"""

import functools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians

CLOSED, OPENED = math.radians(15), math.radians(75)
"""How much further a joint is bent than in that state, up to which folds stay and from which they are open [rad]."""
REACH = 1.5
"""Gain of the label of knuckles, clamped to 1: folds lie up to 8 mm beside a joint."""
PASSES = 25
"""Smoothings over the mesh that carry the colours around a joint over it, about 10 mm."""
FINE_PASSES = 4
"""Smoothings over the mesh that leave a fold's own colours without its lines, 4 mm. Lines stay on bent fingers: without
them these looked like rubber, and blind graders preferred fingers with all of their folds, 28 : 6 on 67 hands."""
LEAST = 0.02
"""Share of folding skin from which a Gaussian has folds."""
MOST = 0.5
"""Largest logarithm by which folds are darker: more is a ring, ink or a shadow."""
MIN_COLOR = 0.02
"""Least colour whose logarithm is taken."""


class Folds(NamedTuple):
    """Folds at M of an avatar's Gaussians."""

    index: Int[Tensor, "M"]
    """Their numbers among all."""
    joint: Int[Tensor, "M"]
    """The joint that opens each, as a row of `HandPose.angles`."""
    darkness: Float[Tensor, "M 3"]
    """Logarithms by which the skin around is brighter, 0 or more."""
    painted: Float[Tensor, "M"]
    """Share of it that is painted, in the state of a straight finger."""
    straight: Float[Tensor, "J"]
    """Flexion of straight fingers [rad]."""
    photo: Float[Tensor, "J"]
    """Flexion in the photo [rad]."""


class _JointSkin(NamedTuple):
    """Skin around the outer joints of fingers: S vertices."""

    vertex: Int[Tensor, "S"]
    """Their numbers."""
    edges: Int[Tensor, "E 2"]
    """Between them, by their places in `vertex`."""
    fold: Float[Tensor, "S"]
    """Share of skin that folds; the rest of bare skin shows the colours around."""
    bare: Float[Tensor, "S"]
    """1 on skin, 0 on nails."""
    joint: Int[Tensor, "V"]
    """Row of `HandPose.angles` of each vertex of the hand; 0 elsewhere."""


@functools.lru_cache(4)
@torch.inference_mode(False)
def _joint_skin(hand: HandModel) -> _JointSkin:
    regions, level = label_regions(hand), (hand.segment - 1) % 3
    last, after_middle = level == 2, hand.bone_t > 0.5
    joint = torch.where((level < 2) & after_middle, hand.segment + 1, hand.segment)  # the nearer end of the bone
    outer = (hand.segment > 0) & ((joint - 1) % 3 > 0) & ~(last & after_middle)
    vertex = torch.nonzero(outer)[:, 0]
    place = torch.full_like(hand.segment, -1).index_copy(0, vertex, torch.arange(len(vertex)).to(hand.segment))
    edges = place[surface.mesh_edges(hand.faces)].long()
    fold = (REACH * regions.knuckle).clamp(max=1)[vertex]
    row = torch.where(outer, joint - 1, 0).long()
    return _JointSkin(vertex, edges[(edges >= 0).all(1)], fold, 1 - regions.nail[vertex], row)


@torch.no_grad()
def find_folds(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    invented: Float[Tensor, "V"] | None,
    angles: Float[Tensor, "J 3"],
) -> Folds:
    """Folds of an avatar over the second and third joints of its fingers.

    Args:
        hand: Model of the surface.
        gaussians: Canonical.
        invented: Share of each vertex that is painted.
        angles: Joint angles in the photo [rad].
    """
    n, like, faces, skin = len(hand.template), gaussians.colors, hand.faces, _joint_skin(hand)
    fold, bare = skin.fold[:, None].to(like), skin.bare[:, None].to(like)
    logs = vertex_colors(gaussians, n)[skin.vertex].clamp_min(MIN_COLOR).log()
    known = (1 - fold) * bare
    around = surface.smooth_over_mesh(torch.cat([logs * known, known], 1), skin.edges, PASSES)
    around = around[:, :3] / around[:, 3:].clamp_min(1e-6)
    own = surface.smooth_over_mesh(logs, skin.edges, FINE_PASSES)
    painted = like.new_zeros(n, 1) if invented is None else invented[:, None].to(like)
    darkness = (around - own).clamp(0, MOST) * fold * bare
    fields = like.new_zeros(n, 4).index_copy(0, skin.vertex, torch.cat([darkness, fold * bare], 1))
    read = vertex_to_gaussians(torch.cat([fields, painted], 1), faces, gaussians)
    index = torch.nonzero(read[:, 3] > LEAST)[:, 0]
    first = torch.cat([gaussians.vertex_index, faces[gaussians.face_index, 0]])[index]
    return Folds(
        index=index,
        joint=skin.joint[first],
        darkness=read[index, :3],
        painted=read[index, 4],
        straight=-hand.rest_bend[1:].to(angles),
        photo=angles[:, 0],
    )


class Opening(NamedTuple):
    """How far folds are open in a pose, or in many."""

    index: Int[Tensor, "M"]
    """Numbers of the Gaussians."""
    logs: Float[Tensor, "*B M 3"]
    """Added to the logarithms of their colours."""


def open_folds(folds: Folds, angles: Float[Tensor, "*B J 3"]) -> Opening:
    """What bent joints add to the colours of folds, where the photo's shade is gone.

    Args:
        folds: By `find_folds`.
        angles: Joint angles [rad].
    """
    beyond = torch.stack([angles[..., 0] - folds.straight, angles[..., 0] - folds.photo], -1)
    opened = ((beyond - CLOSED) / (OPENED - CLOSED)).clamp(0, 1)[..., folds.joint, :]
    share = torch.lerp(opened[..., 1], opened[..., 0], folds.painted)
    return Opening(folds.index, share[..., None] * folds.darkness)
