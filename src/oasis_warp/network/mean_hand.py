"""The mean appearance in each photo's skin tone: `avatar.prior.MeanPrior` in batches, where the network starts."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.prior import DARKEST, LIGHTEST, SIGMA_CAST, SIGMA_COLOR, SIGMA_EXPOSURE, TONES
from oasis_warp.core.hand_model import HandModel


class MeanHand(NamedTuple):
    """What region colours and one brightness a channel say of B hands."""

    colors: Float[Tensor, "B V 3"]
    """Evenly lit mean colours at the vertices."""
    log_melanin: Float[Tensor, "B"]
    """Of the back's melanin share; posterior mean."""
    log_gain: Float[Tensor, "B 3"]
    """Logarithm of the photo's colours over `colors`, posterior mean."""


class MeanHands(nn.Module):
    """Skin tones and mean colours from observed colours; nothing to learn, nothing that is saved."""

    log_tones: Tensor
    table: Tensor

    def __init__(self, hand: HandModel):
        super().__init__()
        tones = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES)
        regions = label_regions(hand)
        colors = torch.stack([region_colors(regions, math.exp(tone)) for tone in tones.tolist()])
        self.register_buffer("log_tones", tones, persistent=False)
        self.register_buffer("table", colors, persistent=False)

    def forward(self, observed: Float[Tensor, "B V 3"], confidence: Float[Tensor, "B V"]) -> MeanHand:
        """See `avatar.prior.estimate_melanin`, which this computes for all tones and hands at once.

        With w the confidence, m a tone's colours and c the observed ones, the best gain of a channel is
        g = sum w m c / sum w m^2 and the squared residual sum w c^2 - g sum w m c.
        """
        total = confidence.sum(1).clamp_min(1e-6)
        model_model = torch.einsum("bv,tvc->btc", confidence, self.table.square()).clamp_min(1e-6)
        model_seen = torch.einsum("bvc,tvc->btc", confidence[..., None] * observed, self.table)
        seen_seen = (confidence[..., None] * observed.square()).sum(1)[:, None]
        gain = model_seen / model_model
        residual = (seen_seen - gain * model_seen).clamp_min(0).sum(2) / (3 * total[:, None])
        log_gain = gain.clamp_min(1e-3).log()
        exposure = log_gain.mean(2) / SIGMA_EXPOSURE
        cast = (log_gain[..., 0::2] - log_gain[..., 1:2]) / SIGMA_CAST
        cost = residual / SIGMA_COLOR**2 + exposure.square() + cast.square().sum(2)
        posterior = torch.softmax(-cost / 2, dim=1)
        log_melanin = posterior @ self.log_tones
        return MeanHand(self._colors_at(log_melanin), log_melanin, (posterior[..., None] * log_gain).sum(1))

    def _colors_at(self, log_melanin: Tensor) -> Tensor:
        """The table, interpolated: a step is a sixth of the tone, the error below 1e-3."""
        step = self.log_tones[1] - self.log_tones[0]
        place = ((log_melanin - self.log_tones[0]) / step).clamp(0, len(self.log_tones) - 1)
        low = place.long().clamp_max(len(self.log_tones) - 2)
        share = (place - low)[:, None, None]
        return (1 - share) * self.table[low] + share * self.table[low + 1]
