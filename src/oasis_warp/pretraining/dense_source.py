"""The synthetic world as a source of labelled photos for the dense network."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.pretraining.synthetic_source import SyntheticSource, seeded
from oasis_warp.synthetic.dense_pictures import DenseBatch, moved, render_dense
from oasis_warp.synthetic.shot_table import sample_tables_ahead
from oasis_warp.synthetic.shots import SceneConfig

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
