"""Colour calibration: gains w and offsets b that make the prior's picture look like the photo (appendix B.3)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.adam import Adam
from oasis_warp.core.config import AdaptConfig
from oasis_warp.losses.image import masked_l1, masked_statistics
from oasis_warp.ops import BlendWeights, blend_colors

RIDGE = 0.02
"""Weight of a plain gain against the photo's own contrast, as a variance [sRGB^2]: shading is not skin colour."""
LEARNING_RATE = 0.005


class Calibration(NamedTuple):
    """Colours become `gain * color + offset`."""

    gain: Float[Tensor, "3"]
    offset: Float[Tensor, "3"]

    def apply(self, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Calibrated colours, kept in [0, 1]."""
        return (colors * self.gain + self.offset).clamp(0, 1)


def closed_form(
    picture: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]
) -> Calibration:
    """Weighted least squares of target = w picture + b, drawn to the pure gain that matches the means.

    Without the ridge a hand that shows one region only has next to no contrast of its own, and w would stretch it to
    the contrast of the photo's shading.
    """
    mean_picture, std_picture = masked_statistics(picture, mask)
    mean_target, _ = masked_statistics(target, mask)
    plain = mean_target / mean_picture.clamp_min(1e-3)
    weight = mask[..., None] / mask.sum().clamp_min(1)
    covariance = ((picture - mean_picture) * (target - mean_target) * weight).sum((0, 1))
    gain = (covariance + RIDGE * plain) / (std_picture**2 + RIDGE)
    return Calibration(gain, mean_target - gain * mean_picture)


def calibrate(
    view: BlendWeights,
    colors: Float[Tensor, "N 3"],
    target: Float[Tensor, "H W 3"],
    mask: Float[Tensor, "H W"],
    config: AdaptConfig,
) -> Calibration:
    """The closed form, then `config.calibration_steps` of Adam on the paper's calibration loss; the identity if off.

    The blended picture is linear in w and b, so the Gaussians are blended once.
    """
    if config.calibration == "off":
        return Calibration(torch.ones_like(colors[0]), torch.zeros_like(colors[0]))
    with torch.no_grad():
        picture = blend_colors(view, colors)
        alpha = view.alphas
        start = closed_form(picture / alpha.clamp_min(1e-3), target, mask * alpha[..., 0])
    gain, offset = start.gain.clone().requires_grad_(True), start.offset.clone().requires_grad_(True)
    optimiser = Adam([gain, offset], LEARNING_RATE)
    goal_mean, goal_std = masked_statistics(target, mask)
    for _ in range(config.calibration_steps):
        image = picture * gain + alpha * offset
        mean, std = masked_statistics(image, mask)
        loss = (
            config.weight_rgb * masked_l1(image, target, mask)
            + config.weight_mean * (mean - goal_mean).abs().sum()
            + config.weight_std * (std - goal_std).abs().sum()
        )
        optimiser.step(loss)
    return Calibration(gain.detach(), offset.detach())
