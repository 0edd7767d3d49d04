"""Pose the hand: shape and joint angles -> surface, joints and finger tips; clamp and mirror poses."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import HandPose, PosedHand
from oasis_warp.hand.correctives import corrected_rest
from oasis_warp.ops import skin as blend_skin


def rest_hand(hand: HandModel, shape: Float[Tensor, "S"]) -> PosedHand:
    """The hand at rest with the given shape coefficients (standard deviations), in its own frame."""
    return PosedHand(
        vertices=hand.template + hand.shape_basis @ shape,
        joints=hand.joints + hand.joint_basis @ shape,
        tips=hand.tips + hand.tip_basis @ shape,
    )


def joint_rotations(hand: HandModel, angles: Float[Tensor, "15 3"]) -> Float[Tensor, "16 3 3"]:
    """Local rotations of all joints, the wrist's the identity: the matrix product flexion @ abduction @ twist."""
    axes = hand.pose_axes[1:]
    flexion, abduction, twist = (from_axis_angle(axes[:, k], angles[:, k]) for k in range(3))
    wrist = torch.eye(3, dtype=angles.dtype, device=angles.device)[None]
    return torch.cat([wrist, flexion @ abduction @ twist])


def bone_transforms(
    hand: HandModel, joints: Float[Tensor, "16 3"], pose: HandPose
) -> tuple[Float[Tensor, "16 3 3"], Float[Tensor, "16 3"]]:
    """Rotation and translation [m] that carry each bone's rest points into the world."""
    local = joint_rotations(hand, pose.angles)
    rotations, origins = [pose.orientation], [pose.orientation @ joints[0] + pose.translation]
    for j in range(1, len(hand.parents)):
        parent = hand.parents[j]
        rotations.append(rotations[parent] @ local[j])
        origins.append(rotations[parent] @ (joints[j] - joints[parent]) + origins[parent])
    rotation = torch.stack(rotations)
    return rotation, torch.stack(origins) - (rotation @ joints[..., None])[..., 0]


def skin(hand: HandModel, rest: PosedHand, pose: HandPose) -> PosedHand:
    """`rest` (from `rest_hand`) in `pose`: pose correctives, then linear blend skinning.

    Differentiable in shape and pose. `hand`, `rest` and `pose` share one dtype and device (`HandModel.to`).
    """
    rotation, translation = bone_transforms(hand, rest.joints, pose)
    surface = corrected_rest(hand, rest.vertices, pose.angles)
    transforms = torch.cat([rotation, translation[..., None]], -1)
    vertices = blend_skin(surface, None, hand.weights, transforms, validate=False).means
    joints = (rotation @ rest.joints[..., None])[..., 0] + translation
    last = torch.tensor([15, 3, 6, 12, 9], device=rotation.device)  # thumb, index, middle, ring, little
    tips = (rotation[last] @ rest.tips[..., None])[..., 0] + translation[last]
    return PosedHand(vertices, joints, tips)


def hand21(posed: PosedHand, hand: HandModel) -> Float[Tensor, "21 3"]:
    """The 21 landmarks [m]: wrist, then base to tip of thumb, index, middle, ring, little."""
    return torch.cat([posed.joints, posed.tips])[hand.keypoint_index]


def clamp_angles(hand: HandModel, angles: Float[Tensor, "15 3"]) -> Float[Tensor, "15 3"]:
    """`angles` [rad], each moved to the nearest value that its joint allows."""
    low, high = hand.pose_limits[1:].unbind(-1)
    return torch.minimum(torch.maximum(angles, low), high)


def mirror_points(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Points seen in the mirror x -> -x, which turns right hands into left ones and back."""
    return points * points.new_tensor([-1.0, 1.0, 1.0])


def mirror_pose(pose: HandPose) -> HandPose:
    """The pose whose right hand is the mirror image of this one's left hand, or the other way round.

    With M = diag(-1, 1, 1), skinning the mirrored surface M v by (M R M, M t) gives M times skinning v by (R, t).
    Joint angles stay: they turn about the model's own axes, which are mirrored with it.
    """
    mirror = pose.orientation.new_tensor([-1.0, 1.0, 1.0])
    return HandPose(
        angles=pose.angles,
        orientation=mirror[:, None] * pose.orientation * mirror,
        translation=mirror * pose.translation,
    )
