"""Knuckles and tendons that stand out on the back of a hand, and the hollows between, as brighter and darker skin."""

import functools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.assets import asset

UNIT = 0.02
"""Height of one step of the stored forms [mm]."""
PER_MM = (0.13, 0.15, 0.16)
"""What a millimetre above the skin around adds to the logarithms of sRGB. Light from one side at 45 degrees changes on
the flank of a tendon, of slope .4, by a fifth to either side: by .09 in sRGB, and tendons stand out by .6 mm."""
MOST = 0.7
"""Height above the skin around to which forms are clamped [mm]."""
BONY, TENDONS = (0.3, 0.9), (0.3, 0.9)
"""Range of how bony people are and how their tendons show; those of the synthetic world have .1 to .9 and .2 to 1."""


def relief_on_back(seed: int, n_vertices: int) -> Float[Tensor, "V"]:
    """How far the back of the hand that `seed` says stands out of the skin some 10 mm around [mm]; 0 on the palm.

    On the CPU.
    """
    forms = _forms()
    assert forms.shape[1] == n_vertices, "the forms are those of the bundled hand"
    bony, tendons = torch.rand(2, generator=torch.Generator().manual_seed(seed + 2)).tolist()
    bony, tendons = (low + share * (high - low) for share, (low, high) in ((bony, BONY), (tendons, TENDONS)))
    return (forms.new_tensor([1, bony, tendons, bony * tendons]) @ forms).clamp(-MOST, MOST)


def relief_shade(seed: int, n_vertices: int) -> Float[Tensor, "V 3"]:
    """What that adds to the logarithms of colours."""
    heights = relief_on_back(seed, n_vertices)
    return heights[:, None] * heights.new_tensor(PER_MM)


@functools.cache
def _forms() -> Float[Tensor, "4 V"]:
    """What all hands have, and what is added for bones, for tendons, and for both [mm]."""
    with asset("skin", "relief.npz").open("rb") as file, np.load(file, allow_pickle=False) as stored:
        return torch.from_numpy(stored["forms"].astype(np.float32) * UNIT)
