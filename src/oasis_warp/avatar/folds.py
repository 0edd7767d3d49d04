"""What bent fingers do to the colours of their skin: folds open, hollows of the back become shallow, knuckles pale.

Skin over a straight joint lies in folds and is darker; over a bent one it is stretched, smooth and paler. Tendons stand
out on the back while fingers are straight, with hollows beside them; in a fist the skin is stretched over both, and has
little blood where it lies on the knuckles. The colours of an avatar are those of one state: painted skin is that of
straight fingers, seen skin that of the photo. They change as the joint bends further.
"""

import functools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, skin_regions
from oasis_warp.core import surface
from oasis_warp.core.hand_model import KNUCKLES, HandModel, finger_of
from oasis_warp.core.types import CanonicalGaussians

CLOSED, OPENED = math.radians(15), math.radians(75)
"""How much further a joint is bent than in that state, up to which folds stay and from which they are open [rad]."""
REACH = 3.0
"""Gain of the label of knuckles, clamped to 1: folds lie up to 8 mm beside a joint. With 1.5 the outermost stayed as
brown spots on bent fingers."""
PASSES = 25
"""Smoothings over the mesh that carry the colours around a joint over it, about 10 mm."""
STRETCHED = (0.10, 0.08, 0.06)
"""What bending adds to the logarithms of colours of folding skin: stretched over the joint it is paler and warmer."""
LEAST = 0.02
"""Share of folding skin from which a Gaussian has folds."""
MOST, OPEN = 0.5, 0.06
"""Largest logarithm by which folds are darker: more is a ring, ink or a shadow. And that which open ones tend to: the
grain of skin stays."""
HOLLOW_PASSES, SHALLOW = 60, 0.1
"""Smoothings that leave the back without tendons and hollows, about 15 mm, and the logarithm that hollows tend to in a
fist: wholly without them a back is a mitten."""
BLANCHED, VALLEY = (0.07, 0.11, 0.11), (-0.06, -0.09, -0.09)
"""What a fist adds to the logarithms of colours on knuckles, and between them."""
HEAD, BETWEEN = 0.007, 0.005
"""Radii of both [m]."""
INK, INK_PASSES = (0.5, 0.7), 6
"""Mean logarithms by which a place differs from the smoothed skin, from which on it may be ink and from which it is,
and smoothings that carry this to what is beside."""
BACK_ENDS = (-0.015, -0.035)
"""Distances to the wrist, along the hand, at which the back's relief begins to go and from which all goes [m]."""
NEAREST = 0.001
"""Distance to the wrist's axis from which a direction from it counts [m]."""
THUMB = 5
"""Number of the thumb by `finger_of`."""
MIN_COLOR = 0.02
"""Least colour whose logarithm is taken."""


class Folds(NamedTuple):
    """Folds at M of an avatar's Gaussians."""

    index: Int[Tensor, "M"]
    """Their numbers among all."""
    row: Int[Tensor, "N"]
    """Place of each Gaussian in `index`, -1 for none; int32."""
    joints: Int[Tensor, "M 2"]
    """The joints that open each, as rows of `HandPose.angles`; over a finger twice the same."""
    between: Float[Tensor, "M 1"]
    """Place between them: 0 at the first, 1 at the second."""
    change: Float[Tensor, "M 3"]
    """Added to the logarithms of their colours when wholly open."""
    painted: Float[Tensor, "M 1"]
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
    """Row of `HandPose.angles` of each vertex of the hand; -1 elsewhere."""


class _BackSkin(NamedTuple):
    """Skin of the back: B vertices."""

    vertex: Int[Tensor, "B"]
    edges: Int[Tensor, "E 2"]
    share: Float[Tensor, "B"]
    """Share of it whose relief goes."""
    knuckles: Float[Tensor, "B 2"]
    """Shares of knuckles and of the valleys between them."""
    joints: Int[Tensor, "V 2"]
    """The nearest first joints of fingers of each vertex of the hand, as rows of `HandPose.angles`."""
    between: Float[Tensor, "V"]
    """Place between them."""


@functools.lru_cache(4)
@torch.inference_mode(False)
def _back_skin(hand: HandModel) -> _BackSkin:
    """The joints beside a vertex are those between whose directions, from the wrist, it lies."""
    joints = hand.keypoint_index[KNUCKLES].flip(0)  # from the little finger on, as places across the hand ascend
    heads, points = hand.joints[joints][:, [0, 2]], hand.template[:, [0, 2]]
    across, place = (torch.atan2(of[:, 1], (-of[:, 0]).clamp_min(NEAREST)) for of in (heads, points))
    first = (torch.searchsorted(across, place) - 1).clamp(0, len(joints) - 2)
    between = ((place - across[first]) / (across[first + 1] - across[first])).clamp(0, 1)
    share = _back_share(hand, joints)
    vertex = torch.nonzero(share > 0)[:, 0]
    bumps = [
        (-(torch.cdist(points[vertex], middles) / size).square()).exp().amax(1)
        for middles, size in ((heads, HEAD), ((heads[1:] + heads[:-1]) / 2, BETWEEN))
    ]
    rows = joints[torch.stack([first, first + 1], 1)] - 1
    return _BackSkin(vertex, edges_among(hand, vertex), share[vertex], torch.stack(bumps, 1), rows, between)


def _back_share(hand: HandModel, joints: Int[Tensor, "4"]) -> Float[Tensor, "V"]:
    """1 on the back of the hand; 0 on the palm, at the wrist, on the thumb, and half along the bones of `joints`."""
    near, far = BACK_ENDS
    before_wrist = ((hand.template[:, 0] - near) / (far - near)).clamp(0, 1)
    of_thumb = hand.weights[:, finger_of(torch.arange(len(hand.parents))) == THUMB].sum(1)
    on_bone = torch.isin(hand.segment, joints) * (2 - 4 * hand.bone_t).clamp(0, 1)
    on_hand = (hand.segment == 0) + on_bone
    return before_wrist * on_hand * (1 - 2 * of_thumb).clamp(0, 1) * (1 - skin_regions(hand).palm)


@functools.lru_cache(4)
@torch.inference_mode(False)
def _joint_skin(hand: HandModel) -> _JointSkin:
    regions, level = label_regions(hand), (hand.segment - 1) % 3
    last, after_middle = level == 2, hand.bone_t > 0.5
    joint = torch.where((level < 2) & after_middle, hand.segment + 1, hand.segment)  # the nearer end of the bone
    outer = (hand.segment > 0) & ((joint - 1) % 3 > 0) & ~(last & after_middle)
    vertex = torch.nonzero(outer)[:, 0]
    fold = (REACH * regions.knuckle).clamp(max=1)[vertex]
    row = torch.where(outer, joint - 1, -1).long()
    return _JointSkin(vertex, edges_among(hand, vertex), fold, 1 - regions.nail[vertex], row)


def edges_among(hand: HandModel, vertex: Int[Tensor, "S"]) -> Int[Tensor, "E 2"]:
    """Edges between these vertices, by their places among them."""
    place = torch.full_like(hand.segment, -1).index_copy(0, vertex, torch.arange(len(vertex)).to(hand.segment))
    edges = place[surface.mesh_edges(hand.faces)].long()
    return edges[(edges >= 0).all(1)]


@torch.no_grad()
def find_folds(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    invented: Float[Tensor, "V"] | None,
    angles: Float[Tensor, "J 3"],
) -> Folds:
    """Folds of an avatar over the second and third joints of its fingers, and the relief of its back.

    Args:
        hand: Model of the surface.
        gaussians: Canonical.
        invented: Share of each vertex that is painted.
        angles: Joint angles in the photo [rad].
    """
    n, like, faces, joint, back = len(hand.template), gaussians.colors, hand.faces, _joint_skin(hand), _back_skin(hand)
    logs = vertex_colors(gaussians, n).clamp_min(MIN_COLOR).log()
    painted = like.new_zeros(n, 1) if invented is None else invented[:, None].to(like)
    on_fingers = torch.cat([logs, like.new_zeros(n, 1)], 1)  # read by Gaussians beside folding skin
    on_fingers = on_fingers.index_copy(0, joint.vertex, _skin_around_folds(joint, logs[joint.vertex]))
    on_back = like.new_zeros(n, 4).index_copy(0, back.vertex, _relief_of_back(back, logs[back.vertex]))
    read = vertex_to_gaussians(torch.cat([on_fingers, on_back, painted], 1), faces, gaussians)
    around, fold, of_back, share, painted = read.split([3, 1, 3, 1, 1], 1)
    beyond = (gaussians.colors.clamp_min(MIN_COLOR).log() - around).clamp(-MOST, 0)
    change = fold * (like.new_tensor(STRETCHED) - beyond_shallow(beyond, OPEN)) + of_back
    index = torch.nonzero((fold + share)[:, 0] > LEAST)[:, 0]
    first = torch.cat([gaussians.vertex_index, faces[gaussians.face_index, 0]])[index]
    over = joint.joint[first]
    return Folds(
        index=index,
        row=rows_of(index, len(like)),
        joints=torch.where(over[:, None] < 0, back.joints[first], over[:, None]).int(),
        between=back.between[first, None],
        change=change[index],
        painted=painted[index],
        straight=-hand.rest_bend[1:].to(angles),
        photo=angles[:, 0],
    )


def rows_of(index: Int[Tensor, "M"], count: int) -> Int[Tensor, "N"]:
    """Place of each of `count` numbers in `index`, -1 for none."""
    rows = torch.arange(len(index), dtype=torch.int32, device=index.device)
    return rows.new_full((count,), -1).index_copy(0, index, rows)


def _skin_around_folds(skin: _JointSkin, logs: Float[Tensor, "S 3"]) -> Float[Tensor, "S 4"]:
    """Logarithms of the colours around a joint, and the share of skin that folds."""
    fold, bare = skin.fold[:, None].to(logs), skin.bare[:, None].to(logs)
    known = (1 - fold) * bare
    around = surface.smooth_over_mesh(torch.cat([logs * known, known], 1), skin.edges, PASSES)
    return torch.cat([around[:, :3] / around[:, 3:].clamp_min(1e-6), fold * bare], 1)


def _relief_of_back(skin: _BackSkin, logs: Float[Tensor, "B 3"]) -> Float[Tensor, "B 4"]:
    """What a fist adds to the back, and the share of skin that it changes: all but ink."""
    around = surface.smooth_over_mesh(logs, skin.edges, HOLLOW_PASSES)
    beyond = logs - around
    share = skin.share[:, None].to(logs) * (1 - ink_share(beyond, skin.edges))
    knuckles = skin.knuckles.to(logs) @ logs.new_tensor([BLANCHED, VALLEY])
    return torch.cat([(knuckles - beyond_shallow(beyond, SHALLOW)) * share, share], 1)


def ink_share(beyond: Float[Tensor, "S 3"], edges: Int[Tensor, "E 2"]) -> Float[Tensor, "S 1"]:
    """Share of ink of vertices whose logarithms of colours differ so much from those of the skin around."""
    low, high = INK
    ink = ((beyond.mean(1, keepdim=True).abs() - low) / (high - low)).clamp(0, 1)
    return (INK_PASSES * surface.smooth_over_mesh(ink, edges, INK_PASSES)).clamp(max=1)


def beyond_shallow(logs: Float[Tensor, "S 3"], shallow: float) -> Float[Tensor, "S 3"]:
    """What must go of logarithms of colours for their mean to tend to `shallow`."""
    depth = logs.mean(1, keepdim=True).abs().clamp_min(1e-6)
    return logs * (1 - shallow * torch.tanh(depth / shallow) / depth)


class Opening(NamedTuple):
    """How far folds are open in a pose, or in many."""

    index: Int[Tensor, "M"]
    """Numbers of the Gaussians."""
    share: Float[Tensor, "*B M 1"]
    """How much of seen skin is open, 0 in the photo's pose: so much of its weak shade is gone."""
    logs: Float[Tensor, "*B M 3"]
    """Added to the logarithms of its colours."""
    painted: Float[Tensor, "*B M 3"]
    """The same for what is painted, which may be open in the photo's pose: added where the photo's shade is gone."""


def opened_by_joints(folds: Folds, angles: Float[Tensor, "*B J 3"]) -> Float[Tensor, "*B J 2"]:
    """How far bent joints open folds that the photo shows, and painted ones, 0 to 1.

    Args:
        folds: By `find_folds`.
        angles: Joint angles [rad].
    """
    beyond = torch.stack([angles[..., 0] - folds.photo, angles[..., 0] - folds.straight], -1)
    return ((beyond - CLOSED) / (OPENED - CLOSED)).clamp(0, 1)


def open_folds(folds: Folds, angles: Float[Tensor, "*B J 3"]) -> Opening:
    """What bent joints add to the colours of folds.

    Args:
        folds: By `find_folds`.
        angles: Joint angles [rad].
    """
    opened = opened_by_joints(folds, angles)[..., folds.joints, :]
    of_photo, of_straight = torch.lerp(*opened.unbind(-2), folds.between).split(1, -1)
    seen, painted = of_photo * (1 - folds.painted), of_straight * folds.painted
    return Opening(folds.index, seen, seen * folds.change, painted * folds.change)
