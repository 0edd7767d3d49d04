"""Feature-on-Mesh: each face mixes the features of its corners by barycentrics of its own (equation 7)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class FeatureOnMesh(nn.Module):
    """Learnable barycentrics, one set a face, kept convex by a softmax; the centroid at first."""

    def __init__(self, n_faces: int):
        super().__init__()
        self.logits = nn.Parameter(torch.zeros(n_faces, 3))

    def forward(self, features: Float[Tensor, "B V C"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B F C"]:
        """Features of the faces."""
        weights = self.logits.softmax(-1)
        parts = (
            features.index_select(1, corner) * weight[:, None].to(features.dtype)
            for corner, weight in zip(faces.unbind(1), weights.unbind(1), strict=True)
        )
        return sum(parts, start=features.new_zeros(()))
