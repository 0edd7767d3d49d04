"""A prior that may be sharp: on skin that the photo hides, details must look real instead of being right.

L1, SSIM and gradients ask for the mean of all hands that a photo allows, which is blurred wherever the photo says
nothing. So on hidden skin only wide means are compared, and a patch discriminator (Isola et al. 2017, with the
logistic loss and R1 penalty of Mescheder et al. 2018) judges what is finer, by itself and by its features (Wang et al.
2018, pix2pixHD).
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, leaky_relu, softplus

from oasis_warp.avatar.observation import inner_mask, source_photos
from oasis_warp.core.types import TrainingBatch
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.pretraining.distributed import ProcessInfo, average_gradients, share_weights
from oasis_warp.pretraining.pretrain import PretrainConfig, StepResult, load_checkpoint, save_checkpoint
from oasis_warp.pretraining.prior_trainer import (
    PriorTrainer,
    RenderBatch,
    draw_targets,
    objective,
    picture_psnr,
    seen_on_targets,
    true_pictures,
)

WIDE = 16
"""Side of the blocks whose means are compared on hidden skin [px]."""
SURROUNDINGS = 17
"""Side of the square whose mean the discriminator does not see [px]: tone is for the means to judge."""
CONTRAST = 5.0
"""Gain of what is left, whose standard deviation is some .02."""
OUTLINE = 3
"""Pixels at outlines that are not judged."""
CHANNELS = (64, 128, 256)
"""Channels of the discriminator's layers; each halves the resolution, and a patch has 46 px."""
ADVERSARY = "adversary.safetensors"
"""The discriminator's checkpoint, beside the network's."""


@dataclass(frozen=True, kw_only=True)
class SharpConfig:
    """Weights of the terms of hidden skin, beside those of `LossConfig`, and the discriminator's training."""

    adversarial: float = 0.1
    """Weight of -log D(drawn)."""
    features: float = 1.0
    """Weight of the mean absolute difference of the discriminator's features."""
    penalty: float = 1.0
    """Weight of R1, the mean squared gradient of D at real patches, halved."""
    learning_rate: float = 2e-4
    """The discriminator's."""


class PatchDiscriminator(nn.Module):
    """Tells drawn from real skin, patch by patch."""

    def __init__(self) -> None:
        super().__init__()
        before, layers = 4, []
        for channels in CHANNELS:
            layers.append(nn.Conv2d(before, channels, 4, 2, 1))
            before = channels
        self.layers, self.last = nn.ModuleList(layers), nn.Conv2d(before, 1, 4, 1, 1)

    def forward(self, patches: Float[Tensor, "N 4 H W"]) -> tuple[Float[Tensor, "N h w"], list[Tensor]]:
        """Logits of being real, and the features of each layer."""
        features, x = [], patches
        for layer in self.layers:
            x = leaky_relu(layer(x), 0.2)
            features.append(x)
        return self.last(x)[:, 0], features


class HiddenSkin(NamedTuple):
    """Where targets show skin that the photo hides; N pictures."""

    share: Float[Tensor, "N H H"]
    """Share of each pixel's skin that the photo hides, 0 beside the hand."""
    judged: Float[Tensor, "N H H"]
    """1 where the discriminator judges: surely hidden, and away from outlines."""


@torch.no_grad()
def hidden_skin(batch: TrainingBatch, masks: Float[Tensor, "N H H"], network: HandNetwork) -> HiddenSkin:
    """Find the skin of the targets that the photos of `batch` hide; `masks` are those of `true_pictures`."""
    confidence = network.observe(source_photos(batch)).confidence
    share = (1 - seen_on_targets(confidence, batch, network.faces, 1.0)).clamp(0, 1)
    judged = inner_mask(((share > 0.9) & (masks > 0.9)).to(masks), OUTLINE)
    return HiddenSkin(share, judged)


def patches_of(images: Float[Tensor, "N H H 3"], judged: Float[Tensor, "N H H"]) -> Float[Tensor, "N 4 H H"]:
    """What the discriminator sees: the skin that is judged without its tone, and where it is."""
    where, pictures = judged[:, None], images.permute(0, 3, 1, 2)

    def around(planes: Tensor) -> Tensor:
        return avg_pool2d(planes, SURROUNDINGS, 1, SURROUNDINGS // 2)

    tone = around(pictures * where) / around(where).clamp_min(1e-3)
    return torch.cat([CONTRAST * (pictures - tone) * where, where], 1)


def weighted_mean(values: Float[Tensor, "N *C h w"], judged: Float[Tensor, "N H H"]) -> Tensor:
    """Mean of `values` over the skin that is judged, at their own resolution."""
    weight = nn.functional.adaptive_avg_pool2d(judged[:, None], values.shape[-2:])
    values = values.reshape(len(values), -1, *values.shape[-2:])
    return (values * weight).sum() / (weight.sum() * values.shape[1]).clamp_min(1)


def wide_difference(
    images: Float[Tensor, "N H H 3"], targets: Float[Tensor, "N H H 3"], weight: Float[Tensor, "N H H"]
) -> Tensor:
    """Mean absolute difference of the mean colours of blocks, over the pixels of `weight`."""
    error = ((images - targets) * weight[..., None]).permute(0, 3, 1, 2)
    return avg_pool2d(error, WIDE).abs().sum() / (3 * avg_pool2d(weight[:, None], WIDE).sum()).clamp_min(1)


class SharpPriorTrainer(PriorTrainer):
    """Trains a network as `PriorTrainer` on what photos show, and against a discriminator on what they hide."""

    def __init__(
        self, network: HandNetwork, config: PretrainConfig, process: ProcessInfo, *, seed: int = 0,
        sharp: SharpConfig = SharpConfig(), **options: Any,
    ):  # fmt: skip
        super().__init__(network, config, process, **options)
        self.sharp = sharp
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.discriminator = PatchDiscriminator().to(process.device)
        on_cuda = process.device.type == "cuda"
        self.judges = [*self.discriminator.parameters()]
        share_weights(self.judges, process.world)
        self.judge_optimizer = torch.optim.Adam(
            self.judges, lr=sharp.learning_rate, betas=(0.0, 0.99), fused=on_cuda, capturable=on_cuda
        )

    def evaluate(self, batch: TrainingBatch) -> StepResult:
        """Predict, render every target and compute the loss; `pictures` are targets, renderings and what is judged."""
        with self.autocast():
            prediction = self.network(source_photos(batch))
        drawn = draw_targets(prediction, batch, self.network)
        true = true_pictures(batch, self.network.faces, self.network.rim)
        hidden = hidden_skin(batch, true.alphas, self.network)
        loss, terms = objective(prediction, drawn, true, self.losses, self.perceptual, 1 - hidden.share)
        more = self._hidden_terms(drawn, true, hidden)
        weights = {"wide": self.losses.rgb, "adversarial": self.sharp.adversarial, "features": self.sharp.features}
        loss = loss + sum((weight * more[name] for name, weight in weights.items()), torch.zeros_like(loss))
        metrics = {"psnr": picture_psnr(drawn, true), **terms, **more}
        return StepResult(loss, metrics, (true.images, drawn.images, hidden.judged))

    def _hidden_terms(self, drawn: RenderBatch, true: RenderBatch, hidden: HiddenSkin) -> dict[str, Tensor]:
        """The terms of hidden skin, and the contrast of what was drawn there over the truth's."""
        fake, real = patches_of(drawn.images, hidden.judged), patches_of(true.images, hidden.judged)
        logits, found = self.discriminator(fake)
        with torch.no_grad():
            _, wanted = self.discriminator(real)
            contrast = (fake[:, :3].square().sum() / real[:, :3].square().sum().clamp_min(1e-6)).sqrt()
        apart = [
            weighted_mean((own - other).abs(), hidden.judged) for own, other in zip(found, wanted, strict=True)
        ]
        return {
            "wide": wide_difference(drawn.images, true.images, true.alphas * hidden.share),
            "adversarial": weighted_mean(softplus(-logits), hidden.judged),
            "features": torch.stack(apart).mean(),
            "hidden_contrast": contrast,
        }

    def _update(self, batch: TrainingBatch) -> StepResult:
        """A step of the network, then one of the discriminator on the same pictures."""
        result = super()._update(batch)
        targets, images, judged = result.pictures
        real = patches_of(targets, judged).requires_grad_()
        fooled, truth = self.discriminator(patches_of(images, judged))[0], self.discriminator(real)[0]
        (slope,) = torch.autograd.grad(truth.sum(), real, create_graph=True)
        loss = (
            weighted_mean(softplus(fooled), judged) + weighted_mean(softplus(-truth), judged)
            + self.sharp.penalty / 2 * slope.square().sum((1, 2, 3)).mean()
        )  # fmt: skip
        for weight, gradient in zip(self.judges, torch.autograd.grad(loss, self.judges), strict=True):
            weight.grad = gradient
        average_gradients(self.judges, self.process.world)
        self.judge_optimizer.step()
        return result._replace(metrics={**result.metrics, "discriminator": loss.detach()})

    def save(self, path: Path) -> None:
        """Write checkpoints of both."""
        super().save(path)
        save_checkpoint(path.with_name(ADVERSARY), self.discriminator, self.judge_optimizer, self.step, {})

    def resume(self, path: Path) -> None:
        """Go on from the checkpoints of both, if there are any.

        Raises:
            InputError: one is damaged, or of another network.
        """
        super().resume(path)
        if self.step:
            load_checkpoint(path.with_name(ADVERSARY), self.discriminator, self.judge_optimizer, {})

    def save_weights(self, path: Path, notes: Mapping[str, Any]) -> None:
        """Write the network's weights, not the discriminator's."""
        super().save_weights(path, {**notes, "sharp": asdict(self.sharp)})

    def sheet(self, batch: TrainingBatch, result: StepResult) -> list[Tensor]:
        """Photos, their first targets and the renderings of these."""
        return super().sheet(batch, result._replace(pictures=result.pictures[:2]))
