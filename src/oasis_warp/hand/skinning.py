"""Pose the hand: shape and joint angles -> surface, joints and finger tips."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp import ops
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel
from oasis_warp.core.rotation import euler_rotations
from oasis_warp.core.types import HandPose, PosedHand
from oasis_warp.ops import BoneTransforms


def rest_hand(hand: HandModel, shape: Float[Tensor, "S"]) -> PosedHand:
    """The hand at rest with the given shape coefficients (standard deviations), in its own frame."""
    return PosedHand(
        vertices=hand.template + hand.shape_basis @ shape,
        joints=hand.joints + hand.joint_basis @ shape,
        tips=hand.tips + hand.tip_basis @ shape,
    )


def bone_transforms(
    hand: HandModel, joints: Float[Tensor, "16 3"], pose: HandPose
) -> tuple[Float[Tensor, "*B 16 3 3"], Float[Tensor, "*B 16 3"]]:
    """Rotation and translation [m] from the rest pose to the world, for each bone."""
    transforms = _bones(hand, joints, pose).transforms
    return transforms[..., :3], transforms[..., 3]


def _bones(hand: HandModel, joints: Tensor, pose: HandPose) -> BoneTransforms:
    return ops.bone_transforms(*pose, joints, hand.pose_axes, hand.parents, validate=False)


PER_JOINT = (0, 2, 9)
"""Pose correctives a joint: none; of its flexion; or of its whole rotation, as MANO has them."""


def correctives_per_joint(hand: HandModel) -> int:
    """Number of pose correctives of each joint but the wrist, one of `PER_JOINT`.

    Raises:
        ValueError: it is another.
    """
    size, n_joints = hand.corrective_basis.shape[-1], len(hand.parents) - 1
    if size not in [n_joints * each for each in PER_JOINT]:
        expected = " or ".join(str(n_joints * each) for each in PER_JOINT)
        raise ValueError(f"hand: expected {expected} pose correctives, got {size}. They belong to joints 1 to 15.")
    return size // n_joints


def corrective_coefficients(hand: HandModel, angles: Float[Tensor, "*B 15 3"]) -> Float[Tensor, "*B C"]:
    """Strengths of the pose correctives at joint `angles` [rad]; empty if the hand has none.

    Correctives are displacements of the rest surface that restore what linear blend skinning loses at bent joints. The
    bundled hand has two per joint, from its flexion: c and c^2 with c = 1 - cos(flexion). Blend skinning shrinks a
    joint by c to leading order, and both vanish at rest with their derivatives. `ops.bone_transforms` computes the same
    for many poses. MANO has nine per joint: R - 1, row by row, R the joint's rotation in the basis of its axes (Loper
    et al. 2015, eq. 9).

    Raises:
        ValueError: `hand` has another number of correctives.
    """
    each = correctives_per_joint(hand)
    if each == 0:
        return angles.new_zeros((*angles.shape[:-2], 0))
    if each == 9:
        return (euler_rotations(angles) - torch.eye(3, dtype=angles.dtype, device=angles.device)).flatten(-3)
    c = 1 - torch.cos(angles[..., 0])
    return torch.stack([c, c * c], -1).flatten(-2)


def skin_surface(hand: HandModel, rest: PosedHand, pose: HandPose) -> Float[Tensor, "*B V 3"]:
    """The vertices of `skin` alone."""
    each = correctives_per_joint(hand)
    if each == 9:
        return _surface(hand, rest, pose, _bones(hand, rest.joints, pose))
    return ops.skinned_vertices(
        *pose, rest.joints, hand.pose_axes, hand.parents, rest.vertices, hand.weights,
        hand.corrective_basis if each else None,
    )  # fmt: skip


def _surface(hand: HandModel, rest: PosedHand, pose: HandPose, bones: BoneTransforms) -> Tensor:
    each = correctives_per_joint(hand)
    strengths = bones.bends if each == 2 else corrective_coefficients(hand, pose.angles)
    return ops.skin(
        rest.vertices,
        None,
        hand.weights,
        bones.transforms,
        displacements=hand.corrective_basis if each else None,
        strengths=strengths if each else None,
        validate=False,
    ).means


def skin(hand: HandModel, rest: PosedHand, pose: HandPose) -> PosedHand:
    """`rest` (from `rest_hand`) in `pose`: pose correctives, then linear blend skinning.

    Differentiable in shape and pose. `hand`, `rest` and `pose` share one dtype and device (`HandModel.to`). The
    correctives are those of the mean hand for all shapes. A batch axis of `pose` is also one of the result.
    """
    bones = _bones(hand, rest.joints, pose)
    every_bone = range(len(hand.parents))
    return PosedHand(
        vertices=_surface(hand, rest, pose, bones),
        joints=_transformed(bones.transforms, every_bone, rest.joints),
        tips=_transformed(bones.transforms, TIP_JOINTS, rest.tips),
    )


def _transformed(transforms: Tensor, bones: Sequence[int], points: Tensor) -> Tensor:
    """Points, each transformed by one of `bones`."""
    # Stacked one by one, because an index list would be copied to the device at every call.
    of_points = torch.stack([transforms[..., bone, :, :] for bone in bones], -3)
    return (of_points[..., :3] @ points[..., None])[..., 0] + of_points[..., 3]


def hand21(posed: PosedHand, hand: HandModel) -> Float[Tensor, "21 3"]:
    """The 21 landmarks [m]: wrist, then base to tip of thumb, index, middle, ring, little."""
    return torch.cat([posed.joints, posed.tips])[hand.keypoint_index]
