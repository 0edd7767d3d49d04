"""Texture learning: the photo's detail goes into the colours, reference views hold the rest (appendix B.3)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.adaptation.picture_fit import Aim, Texture, fit_parameters
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.logging import Progress
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.ops import BlendWeights

LEARNING_RATE = 0.05
"""Of the logits of colour."""
RESIDUAL_DECAY = 0.02
"""Weight of the squared difference of a face's logit from those of its corners: what lies together looks alike."""
ROUGHNESS_DECAY = 0.5
"""Weight of the mean squared difference of what is learned at the two ends of an edge."""
TRUSTED_PIXELS = 0.5
"""Share of the photo [pixels] from which a Gaussian learns freely. One that only shimmers through its neighbours
would be driven to any colour by the last bits of theirs, since Adam's steps do not shrink with the gradient."""
COLOR_MARGIN = 1e-3
"""Distance that colours keep from 0 and 1, where the logit ends."""


def learn_texture(
    gaussians: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    pictures: Aim,
    config: AdaptConfig,
    progress: Progress,
) -> Texture:
    """Learn colours on `pictures`, starting from `gaussians.colors`.

    The unknowns are the logits of a field over the vertices, read by vertex and face Gaussians alike, and a small
    residual of every face Gaussian. A Gaussian that hides behind its neighbours in the photo therefore learns with
    them, and does not come out as a speckle when another pose shows it.
    """
    base = torch.logit(gaussians.colors, COLOR_MARGIN)
    n_vertices, n_points = int(faces.max()) + 1, len(gaussians.vertex_index)
    field = torch.zeros(n_vertices, 3, dtype=base.dtype, device=base.device, requires_grad=True)
    residual = torch.zeros(len(gaussians.face_index), 3, dtype=base.dtype, device=base.device, requires_grad=True)
    still = torch.zeros(n_points, 3, dtype=base.dtype, device=base.device)
    trust, vertex_trust = _trust(gaussians, faces, pictures.view)
    edges = surface.mesh_edges(faces)

    def colors() -> Tensor:
        learned = vertex_to_gaussians(vertex_trust * field, faces, gaussians)
        return torch.sigmoid(base + learned + trust * torch.cat([still, residual]))

    def penalty() -> Tensor:
        ends = (vertex_trust * field).index_select(0, edges.flatten()).unflatten(0, (-1, 2))
        loss = ROUGHNESS_DECAY * (ends[:, 0] - ends[:, 1]).square().mean()
        if len(residual):  # a small photo's hand has none
            loss = loss + RESIDUAL_DECAY * residual.square().mean()
        return loss

    losses = fit_parameters([field, residual], colors, penalty, pictures, LEARNING_RATE, config, progress)
    with torch.no_grad():
        return Texture(colors(), losses)


def _trust(
    gaussians: CanonicalGaussians, faces: Tensor, view: BlendWeights
) -> tuple[Float[Tensor, "N 1"], Float[Tensor, "V 1"]]:
    """How freely each Gaussian, and each vertex through the best Gaussian that reads it, may learn: 0 to 1."""
    pixels = view.transpose @ torch.ones_like(view.alphas).view(-1, 1)
    pixels = pixels.view(-1, len(gaussians.opacities), 1).sum(0)  # of all photos
    trust = (pixels / TRUSTED_PIXELS).clamp(max=1)
    n_points = len(gaussians.vertex_index)
    at_vertices = torch.zeros(int(faces.max()) + 1, 1, dtype=trust.dtype, device=trust.device)
    at_vertices[gaussians.vertex_index] = trust[:n_points]
    for corner in faces[gaussians.face_index].unbind(1):
        at_vertices.scatter_reduce_(0, corner[:, None], trust[n_points:], "amax")
    return trust, at_vertices
