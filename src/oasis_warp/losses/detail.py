"""A perceptual term that needs no weights: differences of neighbouring pixels at several scales."""

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

SCALES = 3
"""Full, half and quarter resolution."""


def detail_difference(
    images: Float[Tensor, "N H W 3"], targets: Float[Tensor, "N H W 3"], masks: Float[Tensor, "N H W"]
) -> Float[Tensor, "N"]:
    """Mean absolute difference of the images' gradients inside the masks, summed over scales.

    Blur and lost lines cost here what a mean of colour differences hardly notices. The place of LPIPS where its
    weights are not at hand.
    """
    error = ((images - targets) * masks[..., None]).permute(0, 3, 1, 2)
    weight, total = masks[:, None], images.new_zeros(len(images))
    for scale in range(SCALES):
        if scale:
            error, weight = avg_pool2d(error, 2), avg_pool2d(weight, 2)
        slopes = error.diff(dim=2).abs().sum((1, 2, 3)) + error.diff(dim=3).abs().sum((1, 2, 3))
        total = total + slopes / (6 * weight.sum((1, 2, 3)).clamp_min(1))
    return total
