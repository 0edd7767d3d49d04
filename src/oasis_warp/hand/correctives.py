"""Pose correctives: displacements of the rest surface that restore what linear blend skinning loses at bent joints."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel


def has_correctives(hand: HandModel) -> bool:
    """Whether `hand` changes its rest surface with its pose.

    Raises:
        ValueError: it does, but with other than two correctives a joint.
    """
    size, expected = hand.corrective_basis.shape[-1], 2 * (len(hand.parents) - 1)
    if size not in (0, expected):
        raise ValueError(f"hand: expected 0 or {expected} pose correctives, got {size}. Two for each joint.")
    return size > 0


def corrective_coefficients(hand: HandModel, angles: Float[Tensor, "15 3"]) -> Float[Tensor, "C"]:
    """Strengths of the displacements in `hand.corrective_basis` at joint `angles` [rad]; empty if the hand has none.

    Two per joint, from its flexion: c and c^2 with c = 1 - cos(flexion). Blend skinning shrinks a joint by c to leading
    order, and both vanish at rest with their derivatives. `ops.bone_transforms` computes the same for many poses.

    Raises:
        ValueError: `hand` has correctives, but not two a joint.
    """
    if not has_correctives(hand):
        return angles.new_zeros(0)
    c = 1 - torch.cos(angles[:, 0])
    return torch.stack([c, c * c], -1).flatten()
