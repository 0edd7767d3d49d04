"""A prior's guess for the photo: several guesses mixed into one, and its colours calibrated (appendix B.3)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.adaptation.adam import Adam
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.losses import masked_l1, masked_statistics
from oasis_warp.ops import BlendWeights, blend_colors

DARKEST = 0.02
"""Below it the ratio of two colours says nothing."""
SMALLEST = 1e-8
"""Scale that stands for none [m]."""
RIDGE = 0.02
"""Weight of a plain gain against the photo's own contrast, as a variance [sRGB^2]: shading is not skin colour."""
LEARNING_RATE = 0.005


def mix_guesses(
    guesses: Sequence[CanonicalGaussians], weight: Float[Tensor, "K V"], faces: Int[Tensor, "F 3"]
) -> CanonicalGaussians:
    """The weighted mean of K guesses of one hand, Gaussian by Gaussian.

    Colours are brought to the first guess's light before, sizes are averaged as logarithms. A Gaussian that some
    guesses lack is the fainter for it. One guess stays as it is.

    Args:
        guesses: On one surface at rest.
        weight: How far to follow each guess at each vertex; positive.
        faces: Faces of the surface.
    """
    if len(guesses) == 1:
        return guesses[0]
    n_vertices, n = weight.shape[1], weight.shape[1] + len(faces)
    weight = torch.cat([weight, weight[:, faces].mean(-1)], 1)
    tables = [_on_all(guess, n_vertices, len(faces)) for guess in guesses]
    present = torch.stack([table.opacities > 0 for table in tables])
    among = weight * present
    among, everywhere = among / among.sum(0).clamp_min(1e-12), weight / weight.sum(0)
    kept = present.any(0)
    on_vertices, on_faces = (torch.nonzero(part)[:, 0] for part in kept.split([n_vertices, n - n_vertices]))

    def mean(parts: Sequence[Tensor], weight: Tensor, rows: Tensor) -> Tensor:
        return torch.stack([w[rows, None] * part[rows] for w, part in zip(weight, parts, strict=True)]).sum(0)

    every, first = torch.nonzero(kept)[:, 0], tables[0].quats
    turned = [torch.where((table.quats * first).sum(-1, keepdim=True) < 0, -1, 1) * table.quats for table in tables]
    barycentrics = mean([table.barycentrics for table in tables], among[:, n_vertices:], on_faces)
    return CanonicalGaussians(
        vertex_index=on_vertices,
        offsets=mean([table.offsets for table in tables], among[:, :n_vertices], on_vertices),
        face_index=on_faces,
        barycentrics=barycentrics / barycentrics.sum(-1, keepdim=True),
        quats=normalize(mean(turned, among, every), dim=-1),
        scales=mean([table.scales.clamp_min(SMALLEST).log() for table in tables], among, every).exp(),
        opacities=mean([table.opacities[:, None] for table in tables], everywhere, every)[:, 0],
        colors=mean(_in_one_light([table.colors for table in tables], present), among, every),
    )


def _on_all(guess: CanonicalGaussians, n_vertices: int, n_faces: int) -> CanonicalGaussians:
    """With a row for every vertex and face; what the guess lacks has opacity 0."""
    rows, n = torch.cat([guess.vertex_index, n_vertices + guess.face_index]), n_vertices + n_faces

    def spread(values: Tensor, where: Tensor, count: int) -> Tensor:
        return values.new_zeros(count, *values.shape[1:]).index_copy(0, where, values)

    return CanonicalGaussians(
        torch.arange(n_vertices, device=rows.device),
        spread(guess.offsets, guess.vertex_index, n_vertices),
        torch.arange(n_faces, device=rows.device),
        spread(guess.barycentrics, guess.face_index, n_faces),
        *(spread(values, rows, n) for values in (guess.quats, guess.scales, guess.opacities, guess.colors)),
    )


def _in_one_light(colors: Sequence[Float[Tensor, "N 3"]], present: Bool[Tensor, "K N"]) -> list[Tensor]:
    """Each times one gain a channel, as bright as the first: a photo cannot tell brown skin from brown light."""
    logs = [table.clamp_min(DARKEST).log() for table in colors]
    common = present.all(0)
    return [
        (table * (logs[0][common] - own[common]).median(0).values.exp()).clamp(0, 1)
        for table, own in zip(colors, logs, strict=True)
    ]


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
