"""The synthetic world as a source of training batches: photos, and targets of the same hands in even light."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import TrainingBatch
from oasis_warp.hand.template import bundled_hand
from oasis_warp.pretraining.training_batch import training_batch
from oasis_warp.synthetic.identity import Population
from oasis_warp.synthetic.people import bake_people
from oasis_warp.synthetic.picture import SyntheticBatch, render_table, slice_batch
from oasis_warp.synthetic.shots import EVERYBODY, PICTURES_EACH, SceneConfig, concatenate_tables, sample_tables_ahead

ERROR_STREAM = 3
"""Stream number of the estimator's errors, beside those of identities and pictures with the same seed."""
SURROUNDINGS = 1.25
"""Side of a rendered picture over that of the crop around its hand."""
EVEN_EVERY = 4
"""One in this number of batches has photos in the even light of its targets, as studio captures have."""
WALL_STREAM = 4
"""Stream number of the colours of the walls behind them."""
MULTIPLE = 16
"""Divisor of a crop's side [px]: the rendered picture and the scales of the losses are whole pixels then."""


def seeded(*numbers: int, device: torch.device | str = "cpu") -> torch.Generator:
    """The random generator of a seed, a stream and a number of it."""
    (state,) = np.random.SeedSequence(numbers).generate_state(1)
    return torch.Generator(device).manual_seed(int(state))


@dataclass(frozen=True, kw_only=True)
class SyntheticSource:
    """What sources of synthetic photos share. On the CPU a batch has the same bits wherever training was resumed."""

    seed: int
    """Seed of the world and of the errors and disturbances of a task."""
    people: int
    """Number of people, who come again and again in other photos."""
    hands: int
    """Photos per batch, each of another person."""
    size: int
    """Side of a picture [px], a multiple of `MULTIPLE`."""
    device: torch.device
    """Where pictures are rendered."""
    population: Population = EVERYBODY
    """What people may have."""
    workers: int = 0
    """Processes that sample shots ahead, or 0."""
    repeats: ClassVar[int] = 1
    """Batches that each rendering serves for."""

    def photo_indices(self, number: int) -> list[int]:
        """Indices of the pictures that are the photos of rendering `number`."""
        return [PICTURES_EACH * (number * self.hands + k) for k in range(self.hands)]

    def people_met(self, rank: int, world: int, steps: int) -> list[int]:
        """The people that process `rank` of `world` shows in a number of steps.

        Each process gets them in another order, so that processes do not bake the same person at the same time.
        """
        renderings = range(rank, min(-(-steps // self.repeats), self.people) * world, world)  # after that people repeat
        met = sorted({(number * self.hands + k) % self.people for number in renderings for k in range(self.hands)})
        first = rank * len(met) // world
        return met[first:] + met[:first]

    def bake(self, met: list[int], folder: Path | None, jobs: int, progress: Progress = silent) -> None:
        """Bake the people of `people_met`, or read those that `folder` holds already.

        Raises:
            ValueError: more than `synthetic.people.max_people_cached`.
            InputError: the folder cannot be written.
        """
        bake_people(self.seed, met, self.population, str(self.device), jobs=jobs, folder=folder, progress=progress)


@dataclass(frozen=True, kw_only=True)
class SyntheticHands(SyntheticSource):
    """A `BatchSource` for the prior."""

    views: int
    """Targets per photo, up to `PICTURES_EACH`."""
    ahead: int = 1
    """Batches that are rendered together, which uses a GPU better and gives the same batches."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[TrainingBatch]:
        """Endless batches. People that have not been baked cost some seconds each."""
        hand = bundled_hand().to(self.device)
        photo = SceneConfig(people=self.people, population=self.population)
        looks = photo, replace(photo, look="even")
        rendered = int(self.size * SURROUNDINGS)

        def numbers() -> Iterator[int]:
            return itertools.count(first_step * world + rank, world)

        def blocks() -> Iterator[tuple[list[int], SceneConfig]]:
            for number in numbers():
                yield from zip((self.photo_indices(number), self.target_indices(number)), looks, strict=True)

        plans, batch_numbers = sample_tables_ahead(self.seed, blocks(), self.workers), numbers()
        while True:
            together = list(itertools.islice(plans, len(looks) * self.ahead))
            photos, targets = (
                render_table(
                    self.seed, concatenate_tables(together[k :: len(looks)]), rendered, self.device, scene=scene
                )
                for k, scene in enumerate(looks)
            )
            for k, number in enumerate(itertools.islice(batch_numbers, self.ahead)):
                photo = slice_batch(photos, slice(k * self.hands, (k + 1) * self.hands))
                target = slice_batch(targets, slice(k * self.hands * self.views, (k + 1) * self.hands * self.views))
                if number % EVEN_EVERY == EVEN_EVERY - 1:
                    photo = self.before_walls(slice_batch(target, slice(None, None, self.views)), number)
                yield training_batch(hand, photo, target, self.size, self.errors(number))

    def target_indices(self, number: int) -> list[int]:
        """Indices of its targets in even light, those of the first photo first."""
        return [index + view for index in self.photo_indices(number) for view in range(self.views)]

    def before_walls(self, pictures: SyntheticBatch, number: int) -> SyntheticBatch:
        """Replace the black background of pictures by plain walls."""
        like = pictures.image
        random = np.random.default_rng([self.seed, WALL_STREAM, number])
        walls = torch.tensor(random.uniform(0.1, 0.9, (len(like), 1, 1, 3)), dtype=like.dtype)
        walls = walls.to(like.device, non_blocking=True)
        return pictures._replace(image=like + (1 - pictures.alpha[..., None]) * walls)

    def errors(self, number: int) -> torch.Generator:
        """The random generator of the estimator's errors in batch `number`."""
        return seeded(self.seed, ERROR_STREAM, number)
