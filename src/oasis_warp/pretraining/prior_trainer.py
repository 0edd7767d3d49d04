"""The learned prior in training (paper, section 4.1 and appendix B.2): its loss, and the files that show it."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.nn.functional import interpolate

from oasis_warp.avatar.observation import source_photos
from oasis_warp.core.types import TrainingBatch
from oasis_warp.losses.image import Perceptual, detail_difference
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import save_network
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.objective import (
    LossConfig,
    draw_targets,
    objective,
    picture_psnr,
    true_pictures,
)
from oasis_warp.pretraining.pretrain import PretrainConfig, StepResult, Trainer

PAPER = LossConfig()


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
