"""What a hand looks like before its photo is fitted: the interface, and the prior that knows mean colours only."""

import functools
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import observe
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop

TONES = 25
"""Skin tones tried, evenly spaced in the logarithm of melanin."""
LIGHTEST, DARKEST = 0.006, 0.35
SIGMA_COLOR = 0.035
"""Expected difference of a lit hand from its region colours [sRGB]."""
SIGMA_EXPOSURE = 0.18
"""Expected logarithm of the photo's brightness over that of an evenly lit hand."""
SIGMA_CAST = 0.155
"""Expected logarithms of red over green and blue over green: the photo's colour cast."""


@runtime_checkable
class Prior(Protocol):
    """Canonical Gaussians of the whole hand from what one photo shows."""

    @property
    def about(self) -> Mapping[str, str | int]:
        """The prior's name and what else tells it from others, for reports."""
        ...

    def __call__(self, crop: HandCrop) -> CanonicalGaussians:
        """Guess the hand of `crop`."""
        ...


class MeanHand(NamedTuple):
    """What region colours and one brightness a channel say of B hands."""

    colors: Float[Tensor, "B V 3"]
    """Evenly lit mean colours at the vertices."""
    log_melanin: Float[Tensor, "B"]
    """Logarithm of the back's melanin share; posterior mean."""
    log_gain: Float[Tensor, "B 3"]
    """Logarithm of the photo's colours over `colors`, posterior mean."""


@functools.lru_cache(4)
@torch.inference_mode(False)
def tone_table(hand: HandModel) -> tuple[Float[Tensor, "T"], Float[Tensor, "T V 3"]]:
    """Logarithms of the melanin of `TONES` skin tones, and the colours of the hand in each; kept, not to be written."""
    tones = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES)
    regions = label_regions(hand)
    return tones, torch.stack([region_colors(regions, math.exp(tone)) for tone in tones.tolist()])


class MeanHands(nn.Module):
    """Skin tones and mean colours from observed colours; nothing to learn, nothing that is saved."""

    log_tones: Tensor
    table: Tensor

    def __init__(self, hand: HandModel):
        super().__init__()
        tones, colors = tone_table(hand)
        self.register_buffer("log_tones", tones, persistent=False)
        self.register_buffer("table", colors, persistent=False)

    def forward(self, observed: Float[Tensor, "B V 3"], confidence: Float[Tensor, "B V"]) -> MeanHand:
        """Posterior means over the tones that explain the observed colours.

        For every tone the best gain of each channel has a closed form; its residual, brightness and cast are weighed by
        their expected sizes. A photo alone cannot tell dark skin in bright light from light skin in dim light, nor
        brown skin from warm light: the posterior mean of the logarithm errs least.
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


class MeanPrior:
    """The mean appearance of palm, back, joints and nails in the photo's skin tone."""

    def __init__(self, hand: HandModel):
        self.about = MappingProxyType({"name": "none"})
        self.hand = hand
        self.regions = label_regions(hand)
        self.mean_hands = MeanHands(hand)

    def __call__(self, crop: HandCrop) -> CanonicalGaussians:
        """Gaussians on the fitted surface with evenly lit mean colours; the photo gives the skin tone only."""
        seen = observe(self.hand, crop)
        mean_hands = self.mean_hands.to(crop.image.device)
        colors = mean_hands(seen.colors[None], seen.confidence[None]).colors[0]
        anchors = place_anchors(self.hand, crop.rest)
        return anchors.with_colors(vertex_to_gaussians(colors, self.hand.faces.to(colors.device), anchors))

    def vertex_colors(self, melanin: float) -> Float[Tensor, "V 3"]:
        """Mean colours at the vertices for a skin tone."""
        return region_colors(self.regions, melanin)
