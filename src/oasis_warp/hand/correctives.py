"""Pose correctives: what linear blend skinning loses at a bent joint, as displacements of the rest surface."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel


def corrective_coefficients(hand: HandModel, angles: Float[Tensor, "15 3"]) -> Float[Tensor, "C"]:
    """Strengths of the displacements in `hand.corrective_basis` at joint `angles` [rad]; empty if the hand has none.

    Two for each joint, from its flexion: c and c^2 with c = 1 - cos(flexion). Blend skinning shrinks a joint by c to
    leading order; both vanish with their slopes at rest.

    Raises:
        ValueError: `hand` has correctives, but not two a joint.
    """
    size = hand.corrective_basis.shape[-1]
    if size == 0:
        return angles.new_zeros(0)
    if size != 2 * len(angles):
        raise ValueError(f"hand: expected 0 or {2 * len(angles)} pose correctives, got {size}. Two for each joint.")
    c = 1 - torch.cos(angles[:, 0])
    return torch.stack([c, c * c], -1).flatten()


def corrected_rest(
    hand: HandModel, vertices: Float[Tensor, "V 3"], angles: Float[Tensor, "15 3"]
) -> Float[Tensor, "V 3"]:
    """The rest surface `vertices` [m] changed so that blend skinning by `angles` [rad] bends it like flesh.

    The displacements are those of the mean hand, whatever the shape of `vertices`.
    """
    if hand.corrective_basis.shape[-1] == 0:
        return vertices
    return vertices + hand.corrective_basis @ corrective_coefficients(hand, angles)
