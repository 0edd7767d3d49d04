"""Texture learning: the photo's detail goes into the colours, reference views hold the rest (appendix B.3).

Geometry is fixed, so a view is blended once and a picture is linear in the colours. They come from a field over the
surface, or, as in the paper, from LoRA on the heads of the prior network.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.adaptation.adam import Adam
from oasis_warp.adaptation.prior_guess import Calibration
from oasis_warp.avatar.anchors import gaussian_corners
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.logging import Progress
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.losses import SsimTarget, masked_dssim, masked_l1, ssim_target
from oasis_warp.network.heads import ColorHeads, head_colors, zero_updates
from oasis_warp.ops import BlendWeights, blend_colors
from oasis_warp.ops.corner_reading import read_corners

AVERAGED = 7
"""The result is the mean of so many last steps, one for each reference view."""


class Targets(NamedTuple):
    """What is drawn, and what it must look like."""

    weights: BlendWeights
    """Weights of the photo. K photos are stacked by `ops.stack_weights`, their pictures and masks one below the
    other."""
    picture: Float[Tensor, "H W 3"]
    """The photo. It shows through where the Gaussians leave it free, as at the wrist: over black they would learn to
    glow there."""
    mask: Float[Tensor, "H W"]
    """Where it counts."""
    references: list[BlendWeights]
    expected: list[Float[Tensor, "H W 3"]]
    """What each reference view must stay like."""
    factors: Float[Tensor, "K N 3"]
    """What the light of each of K photos multiplies colours with; reference views are in even light."""
    perceptual: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None
    """Distance of N images and N targets inside N masks, one number each; the paper's LPIPS."""


class Texture(NamedTuple):
    """What was learned."""

    colors: Float[Tensor, "N 3"]
    losses: tuple[float, ...]
    """Loss of every step, reference views included."""


def make_targets(
    weights: BlendWeights,
    picture: Tensor,
    mask: Tensor,
    references: list[BlendWeights],
    colors: Float[Tensor, "N 3"],
    factors: Float[Tensor, "K N 3"],
) -> Targets:
    """Reference views must stay as Gaussians of `colors` draw them."""
    with torch.no_grad():
        expected = [blend_colors(reference, colors) for reference in references]
    return Targets(weights, picture, mask, references, expected, factors)


def fit_parameters(
    parameters: Sequence[Tensor],
    colors: Callable[[], Float[Tensor, "N 3"]],
    penalty: Callable[[], Tensor],
    targets: Targets,
    rates: tuple[float, float],
    config: AdaptConfig,
    progress: Progress,
) -> tuple[float, ...]:
    """Change `parameters` so that `colors()` draws the targets, and leave their means over the last steps in them.

    Args:
        parameters: Leaves that want gradients.
        colors: Colours of the Gaussians with the parameters as they are.
        penalty: Added to the loss of pictures.
        targets: Those pictures.
        rates: Adam's learning rates of the first step and of the last; they follow half a cosine.
        config: Steps and weights. With `references` "in_turn" one reference view takes part in each step, all of them
            in turn, in an order that `seed` shuffles; with "all" every one, by the photo's loss.
        progress: Called as work goes on.

    Returns:
        The loss of every step, reference views and penalty included.
    """
    beyond = (1 - targets.weights.alphas) * targets.picture
    masked = ssim_target(targets.picture * targets.mask[..., None])
    order = torch.Generator().manual_seed(config.seed)
    optimiser, total = Adam(parameters, rates[0]), config.texture_steps
    losses: list[Tensor] = []
    queue: list[int] = []
    means = [torch.zeros_like(parameter) for parameter in parameters]
    for step in range(total):
        now = colors()
        image = blend_colors(targets.weights, (now * targets.factors).flatten(0, 1)) + beyond
        loss = _picture_loss(image, targets, masked, config)
        if targets.references and config.references == "in_turn":
            queue = queue or torch.randperm(len(targets.references), generator=order).tolist()
            loss = loss + config.weight_reference * _reference_loss(now, targets, queue.pop(), config)
        elif targets.references:
            loss = loss + config.weight_reference * _all_reference_losses(now, targets, config)
        loss = loss + penalty()
        optimiser.rate = rates[1] + (rates[0] - rates[1]) * (1 + math.cos(math.pi * step / total)) / 2
        optimiser.step(loss)
        for mean, value in zip(means, parameters, strict=True):
            mean.lerp_(value.detach(), max(1 / (step + 1), 1 / AVERAGED))
        losses.append(loss.detach())  # read later: on CUDA a step that waits for its loss keeps the next one waiting
        progress("texture", step + 1, total)
    if losses:
        with torch.no_grad():
            for value, mean in zip(parameters, means, strict=True):
                value.copy_(mean)
    return tuple(torch.stack(losses).tolist()) if losses else ()


def _picture_loss(image: Tensor, targets: Targets, masked: SsimTarget, config: AdaptConfig) -> Tensor:
    """Loss of `image` against the photo; `masked` holds the photo inside its mask."""
    picture, mask = targets.picture, targets.mask
    loss = config.weight_rgb * masked_l1(image, picture, mask)
    if targets.perceptual is not None:
        loss = loss + config.weight_perceptual * targets.perceptual(image[None], picture[None], mask[None]).mean()
    return loss + config.weight_ssim * masked_dssim(image * mask[..., None], masked, mask)


def _reference_loss(colors: Tensor, targets: Targets, k: int, config: AdaptConfig) -> Tensor:
    """Loss of reference view k, times the number of views."""
    view = targets.references[k]
    drift = masked_l1(blend_colors(view, colors), targets.expected[k], view.alphas[..., 0])
    return config.weight_rgb * len(targets.references) * drift


def _all_reference_losses(colors: Tensor, targets: Targets, config: AdaptConfig) -> Tensor:
    """The paper's sum over all reference views."""
    total = colors.new_zeros(())
    for reference, expected in zip(targets.references, targets.expected, strict=True):
        image, mask = blend_colors(reference, colors), reference.alphas[..., 0]
        total = total + config.weight_rgb * masked_l1(image, expected, mask)
        total = total + config.weight_ssim * masked_dssim(image, expected, mask)
        if targets.perceptual is not None:
            distance = targets.perceptual(image[None], expected[None], mask[None])
            total = total + config.weight_perceptual * distance.mean()
    return total


LEARNING_RATES = 0.06, 0.006
"""First and last learning rate of the colour logits: 56 steps come as far as 84 of .05."""
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
    targets: Targets,
    config: AdaptConfig,
    progress: Progress,
) -> Texture:
    """Learn colours on `targets`, starting from `gaussians.colors`.

    The unknowns are the logits of a field over the vertices, read by vertex and face Gaussians alike, and a small
    residual of every face Gaussian. A Gaussian that hides behind its neighbours in the photo therefore learns with
    them, and does not come out as a speckle when another pose shows it.
    """
    base = torch.logit(gaussians.colors, COLOR_MARGIN)
    n_vertices, n_points = int(faces.max()) + 1, len(gaussians.vertex_index)
    field = torch.zeros(n_vertices, 3, dtype=base.dtype, device=base.device, requires_grad=True)
    residual = torch.zeros(len(gaussians.face_index), 3, dtype=base.dtype, device=base.device, requires_grad=True)
    none = torch.zeros(n_points, 3, dtype=base.dtype, device=base.device)
    trust, vertex_trust = _trust(gaussians, faces, targets.weights)
    edges, corners = surface.mesh_edges(faces), gaussian_corners(faces, gaussians)

    def colors() -> Tensor:
        learned = read_corners(vertex_trust * field, corners)
        return torch.sigmoid(base + learned + trust * torch.cat([none, residual]))

    def penalty() -> Tensor:
        ends = (vertex_trust * field).index_select(0, edges.flatten()).unflatten(0, (-1, 2))
        loss = ROUGHNESS_DECAY * (ends[:, 0] - ends[:, 1]).square().mean()
        if len(residual):  # a small photo's hand has none
            loss = loss + RESIDUAL_DECAY * residual.square().mean()
        return loss

    losses = fit_parameters([field, residual], colors, penalty, targets, LEARNING_RATES, config, progress)
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


LORA_LEARNING_RATE, FULL_LEARNING_RATE = 0.01, 0.001
"""Learning rates of both factors of every LoRA update, and of all weights in full tuning, where each output sums
hundreds of weights. The paper names none; at a tenth of the first 100 steps come as far as 40 do, and the second lowers
the loss of a photo as fast as the first does."""


def learn_lora(
    heads: ColorHeads, calibration: Calibration, targets: Targets, config: AdaptConfig, progress: Progress
) -> Texture:
    """Learn updates of the heads on `targets`; without a step the colours are the calibrated guess.

    Their rank is `config.lora_rank`, or with `config.texture` "full" any.

    Args:
        heads: Heads of the guess, with what they are asked.
        calibration: Applied to the colours that they put out.
        targets: Pictures of the guess's Gaussians.
        config: Steps and weights.
        progress: Called as work goes on.
    """
    random = torch.Generator().manual_seed(config.seed)
    rank, rate = (None, FULL_LEARNING_RATE) if config.texture == "full" else (config.lora_rank, LORA_LEARNING_RATE)
    updates = [zero_updates(head, rank, random) for head in heads]

    def colors() -> torch.Tensor:
        own = [head_colors(head, update) for head, update in zip(heads, updates, strict=True)]
        return calibration.apply(torch.cat(own))

    factors = [factor for update in updates for pair in update for factor in pair if factor.requires_grad]
    nothing = targets.picture.new_zeros(())
    losses = fit_parameters(factors, colors, lambda: nothing, targets, (rate, rate), config, progress)
    with torch.no_grad():
        return Texture(colors(), losses)


def reference_azimuths(count: int) -> list[float]:
    """Angles of `count` views around the hand, evenly spaced, the photo's own (0) left out [rad]."""
    return [2 * math.pi * k / (count + 1) for k in range(1, count + 1)]
