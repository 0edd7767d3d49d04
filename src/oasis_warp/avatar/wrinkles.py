"""Wrinkles of skin that a pose compresses: at the ball of the thumb, beside it, and on the palm of a fist."""

import functools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians

PHASE_UNIT, DEPTH_UNIT = 1 / 256, 0.01
"""Units of the file's numbers."""
STRENGTH = (0.42, 0.14)
"""Logarithm by which wide and fine wrinkles of depth 1 are darker."""
WIDTH = (0.12, 0.2)
"""Their width over the distance between them."""
RIDGE, RIDGE_WIDTH = 0.3, 0.3
"""How much brighter the skin midway between them is, over a wrinkle's depth, and the width of that."""
LEAST_DEPTH, MORE, UNEVEN = 0.15, 1.3, 2.0
"""The depth of each wrinkle is LEAST_DEPTH + MORE * u ** UNEVEN, with a random u between 0 and 1."""
NARROWEST, WIDER = 0.7, 0.8
"""Its width is NARROWEST + WIDER * u times `WIDTH`."""
HUE = (0.8, 1.08, 1.12)
"""Wrinkles are redder than skin, as shade is (docs/looks_choices.md)."""
NUMBERED, SEED = 512, 7
"""Wrinkles have numbers, and random depths and widths by these."""


def wrinkle_logs(hand: HandModel, gaussians: CanonicalGaussians) -> Float[Tensor, "N 3"]:
    """What is added to the logarithms of the Gaussians' colours where their skin is wholly compressed.

    Wrinkles lie where the phase of their place is a whole number (asset_build/build_wrinkles.py).
    """
    phase, depth = (part.to(gaussians.colors) for part in _wrinkles())
    read = vertex_to_gaussians(torch.cat([phase, depth]).T, hand.faces, gaussians)
    depths, widths = (part.to(gaussians.colors) for part in _variety())
    total = torch.zeros_like(read[:, 0])
    for k, (strength, width) in enumerate(zip(STRENGTH, WIDTH, strict=True)):
        number = read[:, k].round()
        apart, row = (read[:, k] - number).abs(), number.long() % NUMBERED
        line = (-(apart / (width * widths[row])).square()).exp()
        ridge = RIDGE * (-((0.5 - apart) / RIDGE_WIDTH).square()).exp()
        total = total + strength * depths[row] * read[:, 2 + k] * (ridge - line)
    return total[:, None] * total.new_tensor(HUE)


@functools.cache
def _wrinkles() -> tuple[Float[Tensor, "2 V"], Float[Tensor, "2 V"]]:
    """Phase and depth of wide and fine wrinkles at the vertices of the bundled hand."""
    with asset("hand", "wrinkles.npz").open("rb") as file, np.load(file, allow_pickle=False) as stored:
        phase, depth = (torch.from_numpy(stored[name].astype(np.float32)) for name in ("phase", "depth"))
    return PHASE_UNIT * phase, DEPTH_UNIT * depth


@functools.cache
def _variety() -> tuple[Float[Tensor, "L"], Float[Tensor, "L"]]:
    """Depths and widths of wrinkles by their numbers."""
    chance = torch.rand(2, NUMBERED, generator=torch.Generator().manual_seed(SEED))
    return LEAST_DEPTH + MORE * chance[0] ** UNEVEN, NARROWEST + WIDER * chance[1]
