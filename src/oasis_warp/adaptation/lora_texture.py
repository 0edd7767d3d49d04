"""The paper's texture learning: LoRA on the heads of the prior network (appendix B.3).

Of what the paper trains, the colours: views of fixed geometry are blended once. Its term against stretched Gaussians
has nothing to do then, nor has that of the mask.
"""

import torch

from oasis_warp.adaptation.calibrate import Calibration
from oasis_warp.adaptation.picture_fit import Aim, Texture, fit_parameters
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.logging import Progress
from oasis_warp.network.lora import ColorHeads, head_colors, zero_updates

LEARNING_RATE = 0.01
"""Of both factors of every update. The paper names none; at a tenth of it 100 steps come as far as 40 do."""


def learn_lora(
    heads: ColorHeads, calibration: Calibration, aim: Aim, config: AdaptConfig, progress: Progress
) -> Texture:
    """Learn updates of rank `config.lora_rank` on `aim`; without a step the colours are the calibrated guess.

    Args:
        heads: Of the guess, with what they are asked.
        calibration: Applied to the colours that they put out.
        aim: Pictures of the guess's Gaussians.
        config: Steps and weights.
        progress: Called as work goes on.
    """
    random = torch.Generator().manual_seed(config.seed)
    updates = [zero_updates(head, config.lora_rank, random) for head in heads]

    def colors() -> torch.Tensor:
        own = [head_colors(head, update) for head, update in zip(heads, updates, strict=True)]
        return calibration.apply(torch.cat(own))

    factors = [factor for update in updates for pair in update for factor in pair]
    nothing = aim.target.new_zeros(())
    losses = fit_parameters(factors, colors, lambda: nothing, aim, LEARNING_RATE, config, progress)
    with torch.no_grad():
        return Texture(colors(), losses)
