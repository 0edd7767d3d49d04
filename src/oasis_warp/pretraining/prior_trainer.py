"""The learned prior in training (paper, section 4.1 and appendix B.2): its objective, and the files that show it.

The objective renders a prediction in the views of its targets, and compares.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import interpolate

from oasis_warp.avatar.anchors import rim_fade
from oasis_warp.avatar.observation import source_photos
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.types import TrainingBatch
from oasis_warp.losses import Perceptual, detail_difference, masked_dssim, masked_l1
from oasis_warp.network.hand_network import HandNetwork, Prediction
from oasis_warp.network.prior import all_gaussians
from oasis_warp.network.weights_file import save_network
from oasis_warp.ops import depth_map, rasterization
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import PretrainConfig, StepResult, Trainer

MIN_AREA = 0.05
"""Least area of a mask as a share of the picture: limits the weight of hands hidden behind their arms."""


class RenderBatch(NamedTuple):
    """N = B T pictures over black; pixels that the targets leave unknown are black, too."""

    images: Float[Tensor, "N H H 3"]
    alphas: Float[Tensor, "N H H"]


def draw_targets(prediction: Prediction, batch: TrainingBatch, network: HandNetwork) -> RenderBatch:
    """Pose and render the Gaussians of every hand in the pose and camera of each of its targets."""
    size = batch.target_images.shape[2]
    images, alphas = [], []
    for hand in range(len(batch.rest)):
        canonical = all_gaussians(prediction, hand, network.vertex_index, network.face_index)
        posed = pose_gaussians(canonical, network.faces, batch.rest[hand], batch.target_posed[hand])
        for target, (means, quats, scales) in enumerate(zip(*posed[:3], strict=True)):
            image, alpha, _ = rasterization(
                means, quats, scales, posed.opacities, posed.colors, batch.target_viewmats[hand, target][None],
                batch.target_Ks[hand, target][None], size, size, validate=False,
            )  # fmt: skip
            images.append(image[0])
            alphas.append(alpha[0, ..., 0])
    known = batch.target_known.flatten(0, 1)
    return RenderBatch(torch.stack(images) * known[..., None], torch.stack(alphas) * known)


@torch.no_grad()
def seen_on_targets(
    of_vertices: Float[Tensor, "B V"], batch: TrainingBatch, faces: Int[Tensor, "F 3"], elsewhere: float
) -> Float[Tensor, "N H H"]:
    """Values of the vertices as the targets show them, and `elsewhere` where a target shows no hand."""
    size = batch.target_images.shape[2]
    seen = depth_map(
        batch.target_posed.flatten(0, 1), faces, batch.target_viewmats.flatten(0, 1), batch.target_Ks.flatten(0, 1),
        size, size, validate=False,
    )  # fmt: skip
    at_vertices = of_vertices.repeat_interleave(batch.target_posed.shape[1], 0)
    corners = faces[seen.face_ids.clamp_min(0).long()]
    at_corners = at_vertices.gather(1, corners.flatten(1)).view(corners.shape)
    return torch.where(seen.face_ids >= 0, (at_corners * seen.barycentrics).sum(-1), elsewhere)


@torch.no_grad()
def true_pictures(batch: TrainingBatch, faces: Int[Tensor, "F 3"], rim: Int[Tensor, "R"]) -> RenderBatch:
    """The targets, faded out at the wrist like the Gaussians, which must not cover the skin beyond it."""
    fade = seen_on_targets(rim_fade(batch.rest, rim), batch, faces, 1.0)
    share = fade * batch.target_known.flatten(0, 1)
    return RenderBatch(batch.target_images.flatten(0, 1) * share[..., None], batch.target_masks.flatten(0, 1) * share)


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the objective; the paper's."""

    rgb: float = 10.0
    """Weight of the mean absolute colour difference inside the mask."""
    mask: float = 1.0
    """Weight of the absolute error of alpha, over the area of the mask."""
    ssim: float = 1.0
    """Weight of 1 - SSIM."""
    perceptual: float = 5.0
    """Weight of LPIPS, or of the term in its place."""
    position: float = 1.0
    """Weight of `position_loss`."""
    scaling: float = 0.5
    """Weight of `scaling_loss`."""
    offset_limit: float = 0.006
    """Distance of a vertex Gaussian from its vertex that costs nothing [m]."""
    stretch_limit: float = 5.0
    """Ratio of longest to shortest axis that costs nothing, unless the anchor's ratio is larger."""


PAPER = LossConfig()


def objective(
    prediction: Prediction,
    drawn: RenderBatch,
    true: RenderBatch,
    config: LossConfig,
    perceptual: Perceptual = detail_difference,
    compared: Float[Tensor, "N H H"] | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum of all terms, and each term without its weight: means over pictures and Gaussians.

    Colours are compared inside the mask and over black, so holes cost twice; only the mask term counts what is rendered
    outside. With `compared` each pixel's colours count by this share, too.
    """
    images, alphas = drawn
    targets, masks = true
    colored = masks if compared is None else masks * compared
    areas = masks.sum((1, 2)).clamp_min(MIN_AREA * masks[0].numel())
    terms = {
        "rgb": torch.vmap(masked_l1)(images, targets, colored).mean(),
        "mask": ((alphas - masks).abs().sum((1, 2)) / areas).mean(),
        "ssim": torch.vmap(masked_dssim)(images, targets, colored).mean(),
        "perceptual": perceptual(images, targets, colored).mean(),
        "position": position_loss(prediction.offsets, config.offset_limit),
        "scaling": scaling_loss(prediction.scales, prediction.anchor_scales, config.stretch_limit),
    }
    return sum((getattr(config, name) * term for name, term in terms.items()), images.new_zeros(())), terms


def position_loss(offsets: Float[Tensor, "*batch 3"], limit: float) -> Tensor:
    """Mean of max(|offset| - limit, 0), over `limit`."""
    # Away from 0, where the root has no derivative: an untrained network predicts zero offsets.
    length = (offsets.square().sum(-1) + 1e-16).sqrt()
    return (length / limit - 1).clamp_min(0).mean()


def scaling_loss(scales: Float[Tensor, "*batch 3"], anchors: Float[Tensor, "*batch 3"], limit: float) -> Tensor:
    """Mean of max(longest / shortest - limit, 0), where the limit is at least the ratio of the anchor.

    Anchors are flat on purpose, and long on sliver faces: the paper's limit alone would inflate them until they stick
    out of the surface.
    """

    def stretch(axes: Tensor) -> Tensor:
        return axes.amax(-1) / axes.amin(-1)

    return (stretch(scales) - stretch(anchors).clamp_min(limit)).clamp_min(0).mean()


@torch.no_grad()
def picture_psnr(drawn: RenderBatch, true: RenderBatch) -> Tensor:
    """Peak signal-to-noise ratio inside the masks, averaged over the pictures [dB]."""
    error = ((drawn.images - true.images).square() * true.alphas[..., None]).sum((1, 2, 3))
    return (-10 * (error / (3 * true.alphas.sum((1, 2)).clamp_min(1))).clamp_min(1e-12).log10()).mean()


class PriorTrainer(Trainer[HandNetwork, TrainingBatch]):
    """Trains a network to predict the Gaussians of each hand from one photo."""

    def __init__(
        self,
        network: HandNetwork,
        config: PretrainConfig,
        process: ProcessInfo,
        *,
        losses: LossConfig = PAPER,
        perceptual: Perceptual = detail_difference,
    ):
        super().__init__(network, config, process)
        self.losses, self.perceptual = losses, perceptual

    def evaluate(self, batch: TrainingBatch) -> StepResult:
        """Predict, render every target and compute the loss; `pictures` are targets and renderings."""
        with self.autocast():
            prediction = self.network(source_photos(batch))
        drawn = draw_targets(prediction, batch, self.network)
        true = true_pictures(batch, self.network.faces, self.network.rim)
        loss, terms = objective(prediction, drawn, true, self.losses, self.perceptual)
        return StepResult(loss, {"psnr": picture_psnr(drawn, true), **terms}, (true.images, drawn.images))

    def identity(self) -> dict[str, Any]:
        """Config and hand model of the network."""
        return {"config": asdict(self.network.config), "hand_model": self.network.hand_name}

    def save_weights(self, path: Path, notes: Mapping[str, Any]) -> None:
        """Write the weights in half precision; the notes tell the weights of the losses too."""
        save_network(path, self.network, notes=json.dumps({**notes, "losses": asdict(self.losses)}))

    def sheet(self, batch: TrainingBatch, result: StepResult) -> list[Tensor]:
        """Photos, their first targets and the renderings of these."""
        targets, size = batch.target_images.shape[1:3]
        photos = interpolate(batch.image.permute(0, 3, 1, 2), size=(size, size), mode="bilinear").permute(0, 2, 3, 1)
        return [photos, *(pictures[::targets] for pictures in result.pictures)]
