"""Rotations of bones as joint angles of the hand model."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.rotation import euler_angles


def joint_angles(hand: HandModel, local: Float[Tensor, "T 15 3 3"]) -> Float[Tensor, "T 15 3"]:
    """Flexion, abduction and twist [rad] of bones 1 to 15, each turned by `local` in its parent's frame at rest."""
    axes = hand.pose_axes[1:].to(local)
    return euler_angles(axes @ local @ axes.mT)


def angles_of_bones(hand: HandModel, turns: Float[Tensor, "T 16 3 3"]) -> Float[Tensor, "T 15 3"]:
    """Joint angles of bones that are turned by `turns` from rest, in one frame for all; held to the joints' limits.

    The bones of another skeleton are not quite ours: what no joint of the model can do is left out.
    """
    local = turns[:, list(hand.parents[1:])].mT @ turns[:, 1:]
    low, high = hand.pose_limits[1:].to(local).unbind(-1)
    return torch.minimum(torch.maximum(joint_angles(hand, local), low), high)
