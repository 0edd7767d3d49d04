"""What a hand looks like before its photo is fitted: the interface, and the prior that knows mean colours only."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.appearance import Regions, label_regions, region_colors
from oasis_warp.avatar.observation import Observation, observe
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
        """Which prior this is, for reports: its name, and what else tells it from others."""
        ...

    def __call__(self, crop: HandCrop) -> CanonicalGaussians:
        """Guess the hand of `crop`."""
        ...


def estimate_melanin(regions: Regions, seen: Observation) -> float:
    """Melanin share of the hand's back: the mean over the tones that explain the seen colours.

    For every tone the best gain of each channel has a closed form; its residual, brightness and cast are weighed by
    their expected sizes. A photo alone cannot tell dark skin in bright light from light skin in dim light, nor brown
    skin from warm light: the posterior mean of the logarithm errs least.
    """
    weight = seen.confidence[:, None]
    total = weight.sum().clamp_min(1e-6)
    log_melanin = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES)
    costs = []
    for melanin in log_melanin.exp().tolist():
        model = region_colors(regions, melanin)
        gain = (weight * model * seen.colors).sum(0) / (weight * model * model).sum(0).clamp_min(1e-6)
        residual = (weight * (gain * model - seen.colors) ** 2).sum() / (3 * total)
        log_gain = gain.clamp_min(1e-3).log()
        exposure = log_gain.mean() / SIGMA_EXPOSURE
        cast = (log_gain[[0, 2]] - log_gain[1]) / SIGMA_CAST
        costs.append(residual / SIGMA_COLOR**2 + exposure**2 + (cast**2).sum())
    posterior = torch.softmax(-torch.stack(costs).cpu() / 2, dim=0)
    return float((posterior * log_melanin).sum().exp())


class MeanPrior:
    """The mean appearance of palm, back, joints and nails in the photo's skin tone."""

    def __init__(self, hand: HandModel):
        self.about = MappingProxyType({"name": "none"})
        self.hand = hand
        self.regions = label_regions(hand)

    def __call__(self, crop: HandCrop) -> CanonicalGaussians:
        """Gaussians on the fitted surface with evenly lit mean colours; the photo is only asked for the skin tone."""
        seen = Observation(*(part.cpu() for part in observe(self.hand, crop)))
        colors = self.vertex_colors(estimate_melanin(self.regions, seen)).to(crop.image)
        anchors = place_anchors(self.hand, crop.rest)
        faces = self.hand.faces.to(colors.device)
        return anchors.with_colors(vertex_to_gaussians(colors, faces, anchors))

    def vertex_colors(self, melanin: float) -> Float[Tensor, "V 3"]:
        """Mean colours at the vertices for a skin tone."""
        return region_colors(self.regions, melanin)


