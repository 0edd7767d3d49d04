"""The trained network as a prior: what `pipeline.reconstruct` asks before it fits a photo."""

import torch
from jaxtyping import Int
from torch import Tensor

from oasis_warp.avatar.anchors import MIN_OPACITY
from oasis_warp.core.types import CanonicalGaussians, Evidence
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.inputs import Prediction, input_of_evidence


class NetworkPrior:
    """`avatar.prior.Prior` by a `HandNetwork`, in float32."""

    def __init__(self, network: HandNetwork):
        self.network = network.eval()

    @torch.no_grad()
    def __call__(self, evidence: Evidence) -> CanonicalGaussians:
        """The whole hand, guessed from one photo; the network goes where the photo is."""
        prediction = self.network.to(evidence.image.device)(input_of_evidence(evidence))
        return canonical_gaussians(prediction, 0)


def canonical_gaussians(prediction: Prediction, hand: int) -> CanonicalGaussians:
    """The Gaussians of one hand of the batch, without those too faint to be drawn."""
    n_vertices = prediction.offsets.shape[1]
    kept = prediction.opacities[hand] >= MIN_OPACITY
    vertex_index, face_index = (torch.nonzero(part)[:, 0] for part in kept.split([n_vertices, len(kept) - n_vertices]))
    return CanonicalGaussians(
        vertex_index=vertex_index,
        offsets=prediction.offsets[hand][vertex_index],
        face_index=face_index,
        barycentrics=prediction.barycentrics[hand][face_index],
        quats=prediction.quats[hand][kept],
        scales=prediction.scales[hand][kept],
        opacities=prediction.opacities[hand][kept],
        colors=prediction.colors[hand][kept],
    )


def all_gaussians(
    prediction: Prediction, hand: int, vertex_index: Int[Tensor, "V"], face_index: Int[Tensor, "F"]
) -> CanonicalGaussians:
    """The Gaussians of one hand, the faint ones too: sizes depend on no data, and gradients reach all.

    `vertex_index` and `face_index` count all vertices and faces; the same tensors every time spare the operators a
    second look at them.
    """
    return CanonicalGaussians(
        vertex_index,
        prediction.offsets[hand],
        face_index,
        prediction.barycentrics[hand],
        prediction.quats[hand],
        prediction.scales[hand],
        prediction.opacities[hand],
        prediction.colors[hand],
    )
