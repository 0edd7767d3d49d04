"""What the image says at each point: its aligned feature, and how much of it the point itself may believe."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from oasis_warp.network.features import ImageFeatures
from oasis_warp.network.heads import COLOR_MARGIN
from oasis_warp.network.mean_hand import MeanHand
from oasis_warp.network.observation import Sighting
from oasis_warp.network.projection import Aggregation, sample


class PointFeatures(nn.Module):
    """Point-aligned features (equations 1 and 2), projected to the width of tokens; 0 outside the frame.

    Of a full-resolution map, where there is one, the single sample at the projection joins them: a neighbourhood would
    blur the detail that it is there for.
    """

    def __init__(self, aligned: int, fine: int, width: int, neighborhood: int):
        super().__init__()
        self.aggregate = Aggregation(neighborhood)
        self.project = nn.Linear(aligned + fine, width)

    def forward(
        self, features: ImageFeatures, uv: Float[Tensor, "B P 2"], inside: Bool[Tensor, "B P"]
    ) -> Float[Tensor, "B P C"]:
        """Read the maps at `uv`."""
        read = self.aggregate(features.aligned, uv)
        if features.fine is not None:
            read = torch.cat([read, sample(features.fine, uv).to(read.dtype)], dim=-1)
        return self.project(read) * inside[..., None]


def seen_difference(sighting: Sighting, mean: MeanHand) -> Float[Tensor, "B V 3"]:
    """How the photo differs from the mean colours at each vertex, in logits; 0 where it does not show the vertex."""
    difference = torch.logit(sighting.colors, COLOR_MARGIN) - torch.logit(mean.colors, COLOR_MARGIN)
    return difference * sighting.confidence[..., None]


class PointEvidence(nn.Module):
    """Tell a point what the photo shows of it: its aligned feature times its visibility, and how far off the mean.

    Beside that, its mean colour and its visibility: what the heads' changes start from. Not in the paper, where a point
    learns of the photo through a few hundred tokens only; with little training that road is long.
    """

    def __init__(self, width: int):
        super().__init__()
        self.seen = nn.Linear(width, width)
        self.known = nn.Linear(8, width)

    def forward(
        self, aligned: Float[Tensor, "B V C"], seen: Float[Tensor, "B V 3"], sighting: Sighting, mean: MeanHand
    ) -> Float[Tensor, "B V C"]:
        """To be added to the geometric tokens; `seen` is what `seen_difference` says."""
        base = torch.logit(mean.colors, COLOR_MARGIN)
        known = torch.cat([base, seen, sighting.visibility[..., None], sighting.confidence[..., None]], dim=-1)
        return self.seen(aligned * sighting.visibility[..., None]) + self.known(known)
