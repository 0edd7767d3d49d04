"""The dense network in training: its source of labelled photos, its loss, and the files that show it."""

import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import cross_entropy

from oasis_warp.core.bands import split_bands
from oasis_warp.network.dense_network import (
    DEPTHS,
    HAND,
    SURFACE_UNIT,
    WIDTHS,
    DenseNetwork,
    DensePrediction,
    save_dense_network,
)
from oasis_warp.pretraining.pretrain import StepResult, Trainer
from oasis_warp.pretraining.synthetic_source import SyntheticSource, seeded
from oasis_warp.synthetic.dense_pictures import DenseBatch, moved, render_dense
from oasis_warp.synthetic.sensor import srgb
from oasis_warp.synthetic.shots import SceneConfig, sample_tables_ahead

WEIGHTS = {
    "classes": 1.0, "surface": 0.3, "normal": 0.5, "albedo": 2.0, "edges": 1.0, "contrast": 0.03, "finger": 0.1,
}  # fmt: skip
"""Weights of the terms of the loss."""
LEAST_CONTRAST, DARKEST = 1e-3, 0.02
"""Least contrast of a band that counts, and the darkest albedo, encoded as sRGB."""
FEWEST = 400
"""Pixels of skin below which a photo's contrast does not count."""
MILLIMETRES = 1e3 * SURFACE_UNIT


class DenseTrainer(Trainer[DenseNetwork, DenseBatch]):
    """Trains the network to tell what each pixel of a photo shows."""

    def evaluate(self, batch: DenseBatch) -> StepResult:
        """Predict and compute the loss; `pictures` are true and predicted masks, surfaces and albedos."""
        with self.autocast():
            predicted = self.network(batch.image, batch.landmarks)
        terms = dense_loss(predicted, batch)
        loss = sum((WEIGHTS[name] * term for name, term in terms.items()), torch.zeros_like(terms["classes"]))
        # A graph cannot hold indexing by a mask, whose result has no fixed size; so the mean is over all skin.
        distance = (predicted.surface - batch.surface).norm(dim=1) * batch.skin
        terms["surface_mm"] = MILLIMETRES * distance.sum() / batch.skin.sum().clamp_min(1)
        hand = predicted.classes.softmax(1)[:, HAND]
        pictures = (
            batch.classes[:, HAND], hand, _shown(batch.surface, batch.skin), _shown(predicted.surface, hand > 0.5),
            _shown(2 * srgb(batch.albedo) - 1, batch.skin), _shown(2 * predicted.albedo - 1, hand > 0.5),
        )  # fmt: skip
        return StepResult(loss, terms, pictures)

    def identity(self) -> dict[str, Any]:
        """Sizes of the network."""
        return {"widths": list(WIDTHS), "depths": list(DEPTHS)}

    def save_weights(self, path: Path, notes: Mapping[str, Any]) -> None:
        """Write the weights in half precision."""
        save_dense_network(path, self.network, notes=json.dumps({**notes, "loss_weights": WEIGHTS}, sort_keys=True))

    def sheet(self, batch: DenseBatch, result: StepResult) -> list[Tensor]:
        """Photos; masks, surfaces and albedos, each true and predicted."""
        pictures = (
            picture if picture.ndim == 4 else picture[:, None].expand(-1, 3, -1, -1) for picture in result.pictures
        )
        return [picture.permute(0, 2, 3, 1) for picture in (batch.image, *pictures)]


def dense_loss(predicted: DensePrediction, true: DenseBatch) -> dict[str, Tensor]:
    """The terms of the loss, each a mean over pixels.

    classes, finger: cross-entropy. surface: negative log-likelihood of a Laplace distribution with the predicted
    scale. normal: 1 - cosine. albedo: absolute difference in the encoding of sRGB; edges: the same of the differences
    between neighbours, so that lines of the skin stay sharp. contrast: absolute difference of the logarithms of the
    albedo's contrast in four bands of each photo; without it the network would give a mean, which has less.
    """
    skin, albedo = true.skin.float(), srgb(true.albedo)
    count = skin.sum().clamp_min(1)

    def on_skin(values: Float[Tensor, "B H W"]) -> Tensor:
        return torch.where(true.skin, values, 0).sum() / count

    distance = (predicted.surface - true.surface).abs().sum(1)
    difference = predicted.albedo - albedo
    slopes = [difference.diff(dim=axis).abs().mean(1) * torch.minimum(*_neighbours(skin, axis - 1)) for axis in (2, 3)]
    return {
        "classes": -(true.classes * predicted.classes.log_softmax(1)).sum(1).mean(),
        "surface": on_skin(distance * (-predicted.log_scale).exp() + 3 * predicted.log_scale),
        "normal": on_skin(1 - (predicted.normal * true.normal).sum(1)),
        "albedo": on_skin(difference.abs().mean(1)),
        "edges": (slopes[0].sum() + slopes[1].sum()) / count,
        "contrast": _contrast_gap(predicted.albedo, albedo, skin),
        "finger": on_skin(cross_entropy(predicted.finger, true.finger, reduction="none")),
    }


def _contrast_gap(predicted: Float[Tensor, "B 3 H W"], true: Tensor, skin: Float[Tensor, "B H W"]) -> Tensor:
    contrasts = [_contrasts(values.clamp_min(DARKEST).log().mean(1), skin) for values in (predicted, true)]
    first, second = (values.clamp_min(LEAST_CONTRAST).log() for values in contrasts)
    counts = (skin.sum((1, 2)) >= FEWEST).float()[:, None]
    return ((first - second).abs() * counts).mean(1).sum() / counts.sum().clamp_min(1)


def _contrasts(values: Float[Tensor, "B H W"], skin: Float[Tensor, "B H W"]) -> Float[Tensor, "B 4"]:
    """Mean magnitude of each band on the skin."""
    magnitude = split_bands(values, skin).abs() * skin[:, None]
    return magnitude.sum((2, 3)) / skin.sum((1, 2)).clamp_min(1)[:, None]


def _neighbours(values: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """All but the last and all but the first along an axis."""
    size = values.shape[axis] - 1
    return values.narrow(axis, 0, size), values.narrow(axis, 1, size)


def _shown(values: Float[Tensor, "B 3 H W"], where: Bool[Tensor, "B H W"]) -> Tensor:
    """Values in [-1, 1] as colours, black elsewhere."""
    return (0.5 + 0.5 * values).clamp(0, 1) * where[:, None]


DISTURBANCE_STREAM = 5
"""Stream number of the disturbances, beside those of identities and pictures with the same seed."""
UNKNOWN, POINT_UNKNOWN = 0.15, 0.05
"""Shares of photos whose landmarks are not known, and of single landmarks that are not."""
LANDMARK_SIGMAS = (0.004, 0.04)
"""Range of the landmarks' standard deviation, which differs between photos, over the size of the hand."""
FINGER_OFF, FINGER_SIGMA = 0.2, 0.08
"""Share of fingers whose landmarks are off together, and by how much, over the size of the hand."""


@dataclass(frozen=True, kw_only=True)
class DensePhotos(SyntheticSource):
    """A `BatchSource` of labelled photos."""

    repeats: ClassVar[int] = 2
    """The photos of a rendering as they are, then moved."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[DenseBatch]:
        """Endless batches; `landmarks` have a detector's errors, and are NaN where it finds none."""
        scene = SceneConfig(people=self.people, population=self.population)
        first = first_step // self.repeats * world + rank
        blocks = ((self.photo_indices(number), scene) for number in itertools.count(first, world))
        tables = sample_tables_ahead(self.seed, blocks, self.workers)
        step = first_step // self.repeats * self.repeats
        for number, table in zip(itertools.count(first, world), tables, strict=False):
            random = seeded(self.seed, DISTURBANCE_STREAM, number, device=self.device)
            rendered = render_dense(self.seed, table, self.size, self.device, scene=scene, random=random)
            for repeat in range(self.repeats):
                batch = moved(rendered, random) if repeat else rendered
                batch = batch._replace(landmarks=detected(batch.landmarks, random))
                if step >= first_step:
                    yield batch
                step += 1


def detected(landmarks: Float[Tensor, "B 21 2"], random: torch.Generator) -> Float[Tensor, "B 21 2"]:
    """Landmarks [px] with the errors of a detector: noise, fingers that are off, points and hands that are unknown."""
    count = len(landmarks)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random, device=random.device)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, device=random.device)

    low, high = (torch.tensor(sigma).log() for sigma in LANDMARK_SIGMAS)
    size = (landmarks.amax(1) - landmarks.amin(1)).amax(1)[:, None, None]
    noise = (low + (high - low) * uniform(count, 1, 1)).exp() * normal(count, 21, 2)
    fingers = (uniform(count, 5, 1, 1) < FINGER_OFF) * FINGER_SIGMA * normal(count, 5, 1, 2)
    along = torch.tensor([0.1, 0.4, 0.7, 1.0], device=random.device)[:, None]  # from a finger's root to its tip
    noise[:, 1:] += (fingers * along).flatten(1, 2)
    unknown = (uniform(count, 21, 1) < POINT_UNKNOWN) | (uniform(count, 1, 1) < UNKNOWN)
    return torch.where(unknown, torch.nan, landmarks + size * noise)
