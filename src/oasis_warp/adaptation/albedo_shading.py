"""What a photo shows beyond the guess: how much of it is the skin's, and how much goes when the hand turns.

Two photos of one hand agree on little of it. Where skin faces as before, a third to a half of it is found again; where
it has turned by more than 45 degrees, a tenth at most; of what is finer than 2 mm even less
(studies/measure_persistence.py). The rest is soft and hard shadows, gloss,
wrinkles of the pose, and what lies beside its place since the fit is some pixels off. So most of it is shade, which the
photo's own view keeps and other poses lose. Only what no light does to skin is taken for a mark, and stays whole.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.sh_lighting import DARK
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.lighting import split_shade
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians

STAYS = 0.2
"""Share of what is no mark that is taken for skin."""
ACROSS = ((-18.0, 21.3, -7.5), (8.8, 4.6, -8.1))
"""What light does to skin lies along one line in the logarithms of colours, from dark and red to bright and pale. These
are directions across it, over the standard deviations there, on photos of bare hands (`measure_persistence`)."""
MARK = 3.5, 7.0
"""Standard deviations across from which a difference is less likely shade, and from which it is a mark: 98 in 100
vertices of bare skin are below the first; half-transparent ink has 5, ink 15, red polish 24."""
BRIGHT = 0.45, 0.7
"""The same for what is brighter, in the mean of the logarithms: 99 in 100 of bare skin are below the first."""
MOST = 1.5
"""Largest logarithm of shade."""


def split_albedo_shading(
    hand: HandModel, guess: Float[Tensor, "N 3"], learned: CanonicalGaussians
) -> CanonicalGaussians:
    """The learned Gaussians with part of their looks as shade; together colours and shade are as before.

    Args:
        hand: Whose surface it is.
        guess: Colours of the Gaussians before they were learned.
        learned: In even light.
    """
    beyond = (learned.colors.clamp_min(DARK) / guess.clamp_min(DARK)).log().clamp(-MOST, MOST)
    of_vertices = vertex_colors(learned._replace(colors=beyond), len(hand.template))
    sure = vertex_to_gaussians(marks(of_vertices), hand.faces.to(guess.device), learned)
    colors, shade = split_shade(learned.colors, ((1 - STAYS) * (1 - sure) * beyond).exp())
    return learned._replace(colors=colors, shade=shade)


def marks(beyond: Float[Tensor, "V 3"]) -> Float[Tensor, "V 1"]:
    """0 to 1: how surely a difference of the logarithms of colours is a mark on the skin, rather than light."""
    across = (beyond @ beyond.new_tensor(ACROSS).T).norm(dim=-1)
    sure = [
        ((measure - least) / (most - least)).clamp(0, 1)
        for measure, (least, most) in ((across, MARK), (beyond.mean(-1), BRIGHT))
    ]
    return torch.maximum(*sure)[:, None]
