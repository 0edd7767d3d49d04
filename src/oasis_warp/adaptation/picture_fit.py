"""Adam on the colours of fixed geometry: towards the photo in its view, and back to what reference views showed."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.logging import Progress
from oasis_warp.losses.image import masked_dssim, masked_l1
from oasis_warp.ops import BlendWeights, blend_colors

AVERAGED = 10
"""Steps over which what is learned is averaged: Adam's last steps are as long as its first, each for its own view."""
MAX_STEPS = 400
FLAT_WINDOW, FLAT_GAIN = 21, 0.05
"""Without a given number of steps, learning ends when the loss of this many steps, three rounds of seven reference
views, fell by less than this share."""


class Aim(NamedTuple):
    """What is drawn, and what must come out."""

    view: BlendWeights
    """Of the photo; of K photos `ops.stack_weights` of theirs, and what follows is one below the other, too."""
    target: Float[Tensor, "H W 3"]
    """The photo. It shows through where the Gaussians leave it free, as at the wrist: over black they would learn to
    glow there."""
    mask: Float[Tensor, "H W"]
    """Where it counts."""
    references: list[BlendWeights]
    kept: list[Float[Tensor, "H W 3"]]
    """What each reference view must stay like."""
    light: Float[Tensor, "K N 3"] | None = None
    """Factors that the light of each of K photos multiplies colours with; reference views are in even light."""


class Texture(NamedTuple):
    """What was learned."""

    colors: Float[Tensor, "N 3"]
    losses: tuple[float, ...]
    """Of every step, reference views included."""


def aim(
    view: BlendWeights,
    target: Tensor,
    mask: Tensor,
    references: list[BlendWeights],
    colors: Float[Tensor, "N 3"],
    light: Float[Tensor, "K N 3"] | None = None,
) -> Aim:
    """Reference views must stay as Gaussians of `colors` draw them."""
    with torch.no_grad():
        kept = [blend_colors(reference, colors) for reference in references]
    return Aim(view, target, mask, references, kept, light)


def fit_parameters(
    parameters: Sequence[Tensor],
    colors: Callable[[], Float[Tensor, "N 3"]],
    penalty: Callable[[], Tensor],
    aim: Aim,
    learning_rate: float,
    config: AdaptConfig,
    progress: Progress,
) -> tuple[float, ...]:
    """Change `parameters` so that `colors()` draws what it must, and leave their means over the last steps in them.

    Args:
        parameters: Leaves that want gradients.
        colors: Of the Gaussians with the parameters as they are.
        penalty: Added to the loss of pictures.
        aim: Those pictures.
        learning_rate: Of Adam.
        config: Steps and weights. With `references` "in_turn" one reference view takes part in each step, all of them
            in turn, in an order that `seed` shuffles; with "all" every one, by the photo's loss.
        progress: Called as work goes on.

    Returns:
        The loss of every step, reference views and penalty included.
    """
    photo = aim.target * aim.mask[..., None]
    beyond = (1 - aim.view.alphas) * aim.target
    order = torch.Generator().manual_seed(config.seed)
    optimiser = torch.optim.Adam(parameters, lr=learning_rate)
    total = MAX_STEPS if config.texture_steps is None else config.texture_steps
    losses: list[float] = []
    queue: list[int] = []
    settled = [torch.zeros_like(parameter) for parameter in parameters]
    for step in range(total):
        now = colors()
        image = blend_colors(aim.view, now if aim.light is None else (now * aim.light).flatten(0, 1)) + beyond
        loss = config.weight_rgb * masked_l1(image, aim.target, aim.mask)
        loss = loss + config.weight_ssim * masked_dssim(image * aim.mask[..., None], photo, aim.mask)
        if aim.references and config.references == "in_turn":
            queue = queue or torch.randperm(len(aim.references), generator=order).tolist()
            k = queue.pop()
            drift = masked_l1(blend_colors(aim.references[k], now), aim.kept[k], aim.references[k].alphas[..., 0])
            loss = loss + config.weight_reference * config.weight_rgb * len(aim.references) * drift
        elif aim.references:
            loss = loss + config.weight_reference * _drift(now, aim, config)
        loss = loss + penalty()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        for mean, value in zip(settled, parameters, strict=True):
            mean.lerp_(value.detach(), max(1 / (step + 1), 1 / AVERAGED))
        losses.append(loss.item())
        progress("texture", step + 1, total)
        if config.texture_steps is None and _is_flat(losses):
            progress("texture", total, total)
            break
    if losses:
        with torch.no_grad():
            for value, mean in zip(parameters, settled, strict=True):
                value.copy_(mean)
    return tuple(losses)


def _drift(colors: Tensor, aim: Aim, config: AdaptConfig) -> Tensor:
    """The paper's sum over all reference views."""
    total = colors.new_zeros(())
    for reference, kept in zip(aim.references, aim.kept, strict=True):
        image, mask = blend_colors(reference, colors), reference.alphas[..., 0]
        total = total + config.weight_rgb * masked_l1(image, kept, mask)
        total = total + config.weight_ssim * masked_dssim(image, kept, mask)
    return total


def _is_flat(losses: list[float]) -> bool:
    if len(losses) < 2 * FLAT_WINDOW or len(losses) % FLAT_WINDOW:  # ends that differ by a step differ in the result
        return False
    before = sum(losses[-2 * FLAT_WINDOW : -FLAT_WINDOW])
    return sum(losses[-FLAT_WINDOW:]) > (1 - FLAT_GAIN) * before
