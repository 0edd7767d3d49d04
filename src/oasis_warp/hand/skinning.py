"""Pose the hand: shape and joint angles -> surface, joints and finger tips."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import HandPose, PosedHand


def rest_hand(hand: HandModel, shape: Float[Tensor, "S"]) -> PosedHand:
    """The hand at rest with the given shape coefficients (standard deviations), in its own frame."""
    return PosedHand(
        vertices=hand.template + hand.shape_basis @ shape,
        joints=hand.joints + hand.joint_basis @ shape,
        tips=hand.tips + hand.tip_basis @ shape,
    )


def joint_rotations(hand: HandModel, angles: Float[Tensor, "15 3"]) -> Float[Tensor, "16 3 3"]:
    """Local rotations of all joints, the wrist's the identity: flexion, then abduction, then twist, as matrix product."""
    axes = hand.pose_axes[1:].to(angles)
    flexion, abduction, twist = (from_axis_angle(axes[:, k], angles[:, k]) for k in range(3))
    wrist = torch.eye(3, dtype=angles.dtype, device=angles.device)[None]
    return torch.cat([wrist, flexion @ abduction @ twist])


def bone_transforms(
    hand: HandModel, joints: Float[Tensor, "16 3"], pose: HandPose
) -> tuple[Float[Tensor, "16 3 3"], Float[Tensor, "16 3"]]:
    """Rotation and translation that carry each bone's rest points into the world."""
    local = joint_rotations(hand, pose.angles)
    rotations, origins = [pose.orientation], [pose.orientation @ joints[0] + pose.translation]
    for j in range(1, len(hand.parents)):
        parent = hand.parents[j]
        rotations.append(rotations[parent] @ local[j])
        origins.append(rotations[parent] @ (joints[j] - joints[parent]) + origins[parent])
    rotation = torch.stack(rotations)
    return rotation, torch.stack(origins) - (rotation @ joints[..., None])[..., 0]


def skin(hand: HandModel, rest: PosedHand, pose: HandPose) -> PosedHand:
    """Linear blend skinning of `rest` (from `rest_hand`) into `pose`. Differentiable in shape and pose."""
    rotation, translation = bone_transforms(hand, rest.joints, pose)
    blend = (hand.weights @ rotation.flatten(1)).unflatten(1, (3, 3))
    vertices = (blend @ rest.vertices[..., None])[..., 0] + hand.weights @ translation
    joints = (rotation @ rest.joints[..., None])[..., 0] + translation
    last = torch.tensor([15, 3, 6, 12, 9], device=rotation.device)  # thumb, index, middle, ring, little
    tips = (rotation[last] @ rest.tips[..., None])[..., 0] + translation[last]
    return PosedHand(vertices, joints, tips)
