"""Pose many hands of different shapes at once, in a fixed and small number of launches."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import inset_offsets
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.hand.skinning import corrective_coefficients

FINGERS, BONES = 5, 3
"""The bones of a finger follow each other in `HandModel`. All fingers are posed together, from the palm outwards."""


class PosedHands(NamedTuple):
    """N right hands [m]; their surfaces are those that Gaussians are bound to."""

    rest: Float[Tensor, "N V 3"]
    posed: Float[Tensor, "N V 3"]
    landmarks: Float[Tensor, "N 21 3"]
    """See `hand.skinning.hand21`."""
    rotations: Float[Tensor, "N V 3 3"]
    """Blended linear parts of the skinning transforms from rest to pose: nearly rotations."""


def pose_hands(
    hand: HandModel,
    shape: Float[Tensor, "N S"],
    angles: Float[Tensor, "N 15 3"],
    orientation: Float[Tensor, "N 3 3"],
    translation: Float[Tensor, "N 3"],
) -> PosedHands:
    """`hand.skinning.rest_hand`, moved by `avatar.anchors.inset_offsets`, `skin` and `hand21` for many hands."""
    rest = hand.template + inset_offsets(hand) + torch.einsum("vds,ns->nvd", hand.shape_basis, shape)
    joints = hand.joints + torch.einsum("jds,ns->njd", hand.joint_basis, shape)
    tips = hand.tips + torch.einsum("tds,ns->ntd", hand.tip_basis, shape)
    rotation, origin = _bones(hand, joints, angles, orientation, translation)
    offset = origin - (rotation @ joints[..., None])[..., 0]
    blended = torch.einsum("vj,njk->nvk", hand.weights, torch.cat([rotation.flatten(2), offset], dim=2))
    strengths = torch.vmap(lambda a: corrective_coefficients(hand, a))(angles)
    corrected = rest + torch.einsum("vdc,nc->nvd", hand.corrective_basis, strengths)
    rotations = blended[..., :9].unflatten(2, (3, 3))
    posed = (rotations * corrected[:, :, None]).sum(-1) + blended[..., 9:]
    last = [torch.stack([part[:, bone] for bone in TIP_JOINTS], 1) for part in (rotation, offset)]
    ends = (last[0] @ tips[..., None])[..., 0] + last[1]
    return PosedHands(rest, posed, torch.cat([origin, ends], 1)[:, hand.keypoint_index], rotations)


def _bones(
    hand: HandModel, joints: Tensor, angles: Tensor, orientation: Tensor, translation: Tensor
) -> tuple[Tensor, Tensor]:
    """Rotations and positions of all bones, [N, 16, 3, 3] and [N, 16, 3]."""
    about = from_axis_angle(hand.pose_axes[1:].expand(len(angles), -1, -1, -1), angles)
    local = (about[:, :, 0] @ about[:, :, 1] @ about[:, :, 2]).unflatten(1, (FINGERS, BONES))
    at_rest = joints[:, 1:].unflatten(1, (FINGERS, BONES))
    palm = (orientation @ joints[:, 0, :, None])[..., 0] + translation
    rotation, origin, start = orientation[:, None], palm[:, None], joints[:, :1]
    rotations, origins = [], []
    for k in range(BONES):
        origin = origin + (rotation @ (at_rest[:, :, k] - start)[..., None])[..., 0]
        rotation, start = rotation @ local[:, :, k], at_rest[:, :, k]
        rotations.append(rotation)
        origins.append(origin)
    return (
        torch.cat([orientation[:, None], torch.stack(rotations, 2).flatten(1, 2)], 1),
        torch.cat([palm[:, None], torch.stack(origins, 2).flatten(1, 2)], 1),
    )
