"""What an image encoder hands on, and how a crop is made ready for one."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate


class ImageFeatures(NamedTuple):
    """Feature maps of B crops."""

    aligned: Float[Tensor, "B C h w"]
    """Read at the projections of points."""
    deep: Float[Tensor, "B D y x"]
    """For the global token, and for tokens that are not aligned with geometry."""
    fine: Float[Tensor, "B E S S"] | None
    """Read at the projections too, at the crop's full resolution, if the encoder has such a map."""


def resampled(
    image: Float[Tensor, "B S S 3"], mask: Float[Tensor, "B S S"], size: int
) -> tuple[Float[Tensor, "B 3 s s"], Float[Tensor, "B 1 s s"]]:
    """The crop at the encoder's resolution, channels first: colours times mask, and mask.

    Times mask before and not after the resampling, so that the background does not bleed over the hand's outline.
    """
    planes = torch.cat([(image * mask[..., None]).permute(0, 3, 1, 2), mask[:, None]], dim=1)
    if planes.shape[-1] != size:
        planes = interpolate(planes, size=(size, size), mode="bilinear", antialias=planes.shape[-1] > size)
    return planes[:, :3], planes[:, 3:]
