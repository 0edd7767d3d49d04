"""The synthetic world as a source of labelled photos for the dense network."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from numpy.random import SeedSequence
from torch import Tensor

from oasis_warp.core.logging import Progress, silent
from oasis_warp.synthetic.dense_pictures import DenseBatch, moved, render_dense
from oasis_warp.synthetic.identity import Population
from oasis_warp.synthetic.people import bake_people
from oasis_warp.synthetic.shot_table import sample_tables_ahead
from oasis_warp.synthetic.shots import EVERYBODY, PICTURES_EACH, SceneConfig

REPEATS = 2
"""Batches that each rendering serves for: as it is, then moved."""
DISTURBANCE_STREAM = 5
"""Stream number of the disturbances, beside those of identities and pictures with the same seed."""
UNKNOWN, POINT_UNKNOWN = 0.15, 0.05
"""Shares of photos whose landmarks are not known, and of single landmarks that are not."""
LANDMARK_SIGMAS = (0.004, 0.04)
"""Range of the landmarks' standard deviation, which differs between photos, over the size of the hand."""
FINGER_OFF, FINGER_SIGMA = 0.2, 0.08
"""Share of fingers whose landmarks are off together, and by how much, over the size of the hand."""


@dataclass(frozen=True, kw_only=True)
class DensePhotos:
    """A `BatchSource` of labelled photos. On the CPU a batch has the same bits wherever training was resumed."""

    seed: int
    """Seed of the world and of the disturbances."""
    people: int
    """Number of people, who come again and again in other photos."""
    photos: int
    """Per batch, each of another person."""
    size: int
    """Side of a photo [px], a multiple of 16."""
    device: torch.device
    """Where photos are rendered."""
    population: Population = EVERYBODY
    """What people may have."""
    workers: int = 0
    """Processes that sample shots ahead, or 0."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[DenseBatch]:
        """Endless batches; `landmarks` have a detector's errors, and are NaN where it finds none."""
        scene = SceneConfig(people=self.people, population=self.population)
        first = first_step // REPEATS * world + rank
        blocks = ((self.indices(number), scene) for number in itertools.count(first, world))
        tables = sample_tables_ahead(self.seed, blocks, self.workers)
        step = first_step // REPEATS * REPEATS
        for number, table in zip(itertools.count(first, world), tables, strict=False):
            random = torch.Generator(self.device).manual_seed(self._state(number))
            rendered = render_dense(self.seed, table, self.size, self.device, scene=scene, random=random)
            for repeat in range(REPEATS):
                batch = moved(rendered, random) if repeat else rendered
                batch = batch._replace(landmarks=detected(batch.landmarks, random))
                if step >= first_step:
                    yield batch
                step += 1

    def indices(self, number: int) -> list[int]:
        """Indices of the pictures of rendering `number`, each of another person."""
        return [PICTURES_EACH * (number * self.photos + k) for k in range(self.photos)]

    def people_met(self, rank: int, world: int, steps: int) -> list[int]:
        """The people that process `rank` of `world` shows in a number of steps."""
        renderings = range(rank, min(-(-steps // REPEATS), self.people) * world, world)
        return sorted({(number * self.photos + k) % self.people for number in renderings for k in range(self.photos)})

    def bake(self, met: list[int], folder: Path | None, jobs: int, progress: Progress = silent) -> None:
        """Bake the people of `people_met`, or read those that `folder` holds already (see `people.bake_people`)."""
        bake_people(self.seed, met, self.population, str(self.device), jobs=jobs, folder=folder, progress=progress)

    def _state(self, number: int) -> int:
        return int(SeedSequence([self.seed, DISTURBANCE_STREAM, number]).generate_state(1)[0])


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
