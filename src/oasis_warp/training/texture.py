"""Texture learning: the photo's detail goes into the colours, reference views hold the rest (appendix B.3)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.logging import Progress
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.losses.image import masked_dssim, masked_l1
from oasis_warp.ops import BlendWeights, blend_colors

LEARNING_RATE = 0.05
"""Of the logits of colour."""
RESIDUAL_DECAY = 0.02
"""Weight of the squared difference of a face's logit from those of its corners: what lies together looks alike."""
ROUGHNESS_DECAY = 0.5
"""Weight of the mean squared difference of what is learned at the two ends of an edge."""
TRUSTED_PIXELS = 0.5
"""Share of the photo [pixels] from which a Gaussian learns freely. One that only shimmers through its neighbours
would be driven to any colour by the last bits of theirs, since Adam's steps do not shrink with the gradient."""
AVERAGED = 10
"""Steps over which what is learned is averaged: Adam's last steps are as long as its first, each for its own view."""
MAX_STEPS = 400
FLAT_WINDOW, FLAT_GAIN = 21, 0.05
"""Without a given number of steps, learning ends when the loss of this many steps, three rounds of seven reference
views, fell by less than this share."""
COLOR_MARGIN = 1e-3
"""Distance that colours keep from 0 and 1, where the logit ends."""


class Texture(NamedTuple):
    """What was learned."""

    colors: Float[Tensor, "N 3"]
    losses: tuple[float, ...]
    """Of every step, reference view included."""


def learn_texture(
    gaussians: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    view: BlendWeights,
    target: Float[Tensor, "H W 3"],
    mask: Float[Tensor, "H W"],
    references: list[BlendWeights],
    config: AdaptConfig,
    progress: Progress,
) -> Texture:
    """Learn colours on `target` inside `mask`, starting from `gaussians.colors`.

    The unknowns are the logits of a field over the vertices, read by vertex and face Gaussians alike, and a small
    residual of every face Gaussian. A Gaussian that hides behind its neighbours in the photo therefore learns with
    them, and does not come out as a speckle when another pose shows it. The photo itself shows through where the
    Gaussians leave it free, as at the wrist: over black they would learn to glow there. Reference views must stay as
    `gaussians` draws them; one of them takes part in each step, all of
    them in turn, in an order that `config.seed` shuffles.
    """
    base = torch.logit(gaussians.colors, COLOR_MARGIN)
    n_vertices, n_points = int(faces.max()) + 1, len(gaussians.vertex_index)
    field = torch.zeros(n_vertices, 3, dtype=base.dtype, device=base.device, requires_grad=True)
    residual = torch.zeros(len(gaussians.face_index), 3, dtype=base.dtype, device=base.device, requires_grad=True)
    still = torch.zeros(n_points, 3, dtype=base.dtype, device=base.device)
    trust, vertex_trust = _trust(gaussians, faces, view)
    edges = surface.mesh_edges(faces)

    def colors(field: Tensor, residual: Tensor) -> Tensor:
        learned = vertex_to_gaussians(vertex_trust * field, faces, gaussians)
        return torch.sigmoid(base + learned + trust * torch.cat([still, residual]))

    with torch.no_grad():
        goals = [blend_colors(reference, gaussians.colors) for reference in references]
    photo = target * mask[..., None]
    beyond = (1 - view.alphas) * target
    order = torch.Generator().manual_seed(config.seed)
    optimiser = torch.optim.Adam([field, residual], lr=LEARNING_RATE)
    total = MAX_STEPS if config.texture_steps is None else config.texture_steps
    losses: list[float] = []
    views: list[int] = []
    settled = [torch.zeros_like(field), torch.zeros_like(residual)]
    for step in range(total):
        now = colors(field, residual)
        image = blend_colors(view, now) + beyond
        loss = config.weight_rgb * masked_l1(image, target, mask)
        loss = loss + config.weight_ssim * masked_dssim(image * mask[..., None], photo, mask)
        if references:
            views = views or torch.randperm(len(references), generator=order).tolist()
            k = views.pop()
            drift = masked_l1(blend_colors(references[k], now), goals[k], references[k].alphas[..., 0])
            loss = loss + config.weight_reference * config.weight_rgb * len(references) * drift
        ends = (vertex_trust * field).index_select(0, edges.flatten()).unflatten(0, (-1, 2))
        loss = loss + ROUGHNESS_DECAY * (ends[:, 0] - ends[:, 1]).square().mean()
        if len(residual):  # a small photo's hand has none
            loss = loss + RESIDUAL_DECAY * residual.square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        for mean, value in zip(settled, (field, residual), strict=True):
            mean.lerp_(value.detach(), max(1 / (step + 1), 1 / AVERAGED))
        losses.append(loss.item())
        progress("texture", step + 1, total)
        if config.texture_steps is None and _is_flat(losses):
            progress("texture", total, total)
            break
    return Texture(colors(*settled), tuple(losses))


def _trust(
    gaussians: CanonicalGaussians, faces: Tensor, view: BlendWeights
) -> tuple[Float[Tensor, "N 1"], Float[Tensor, "V 1"]]:
    """How freely each Gaussian, and each vertex through the best Gaussian that reads it, may learn: 0 to 1."""
    pixels = view.transpose @ torch.ones_like(view.alphas).view(-1, 1)
    trust = (pixels / TRUSTED_PIXELS).clamp(max=1)
    n_points = len(gaussians.vertex_index)
    at_vertices = torch.zeros(int(faces.max()) + 1, 1, dtype=trust.dtype, device=trust.device)
    at_vertices[gaussians.vertex_index] = trust[:n_points]
    for corner in faces[gaussians.face_index].unbind(1):
        at_vertices.scatter_reduce_(0, corner[:, None], trust[n_points:], "amax")
    return trust, at_vertices


def _is_flat(losses: list[float]) -> bool:
    if len(losses) < 2 * FLAT_WINDOW or len(losses) % FLAT_WINDOW:  # ends that differ by a step differ in the result
        return False
    before = sum(losses[-2 * FLAT_WINDOW : -FLAT_WINDOW])
    return sum(losses[-FLAT_WINDOW:]) > (1 - FLAT_GAIN) * before
