"""Batches of a data set for the prior's training, alone or mixed with synthetic people."""

import itertools
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose, TrainingBatch
from oasis_warp.datasets.samples import Catalogue, Models, Picture, Sample, load_picture
from oasis_warp.hand.mano_hand import hand_pose_of_mano
from oasis_warp.ops import depth_map
from oasis_warp.pretraining.hand_batch import pose_hands
from oasis_warp.pretraining.synthetic_source import SURROUNDINGS, SyntheticHands, seeded
from oasis_warp.pretraining.training_batch import EstimatorNoise, training_batch

STREAM, MIX_STREAM = 5, 6
"""Stream numbers of the choice of samples, and of data set or synthetic people, beside those of synthetic sources."""
TRIES = 20
"""Samples that cannot be loaded, one after the other, before a training ends."""
NOISE = EstimatorNoise(surface=0.0)
"""Poses of data sets are estimates with errors of their own."""


class DatasetPictures(NamedTuple):
    """As `pretraining.training_batch.LabelledPictures`; all are right hands."""

    image: Tensor
    alpha: Tensor
    mask: Tensor
    angles: Tensor
    orientation: Tensor
    translation: Tensor
    shape: Tensor
    K: Tensor
    left: Tensor


@dataclass(frozen=True, kw_only=True)
class DatasetHands:
    """A `BatchSource`: photos, each with `views` other pictures of the same hand of the same person as targets."""

    catalogue: Catalogue
    models: Models
    hand: HandModel
    """`mano_hand`, on the CPU."""
    seed: int
    hands: int
    """Photos per batch."""
    views: int
    size: int
    """Side of a picture [px]."""
    device: torch.device
    workers: int = 0
    """Batches that threads load ahead."""
    failed: dict[str, str] = field(default_factory=dict)
    """Samples that could not be loaded, with the reason; others took their place."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[TrainingBatch]:
        """Endless batches."""
        hand, groups = self.hand.to(self.device), self._groups()
        following = itertools.count(first_step * world + rank, world)
        with ThreadPoolExecutor(max(self.workers, 1)) as pool:  # decoding and resampling leave Python's lock

            def ahead(number: int) -> tuple[int, Future[list[list[Picture]]]]:
                return number, pool.submit(self._loaded, groups, number)

            loading = deque(ahead(number) for number in itertools.islice(following, max(self.workers, 1)))
            while True:
                number, pictures = loading.popleft()
                batch = self._batch(hand, pictures.result(), number)
                loading.append(ahead(next(following)))
                yield batch

    def _groups(self) -> list[list[Sample]]:
        """Samples of one hand of one person each."""
        table: dict[tuple[str, str], list[Sample]] = {}
        for sample in self.catalogue.samples:
            table.setdefault((sample.subject, sample.side), []).append(sample)
        return [table[key] for key in sorted(table)]

    def _loaded(self, groups: list[list[Sample]], number: int) -> list[list[Picture]]:
        """Of every hand of a batch the photo and its targets."""
        random = np.random.default_rng([self.seed, STREAM, number])
        chosen = [groups[random.integers(len(groups))] for _ in range(self.hands)]
        return [[self._load(group, random) for _ in range(1 + self.views)] for group in chosen]

    def _batch(self, hand: HandModel, chosen: list[list[Picture]], number: int) -> TrainingBatch:
        photos, targets = [each[0] for each in chosen], [picture for each in chosen for picture in each[1:]]
        seen, goals = (self._pictures(hand, pictures) for pictures in (photos, targets))
        goals = goals._replace(image=goals.image * goals.mask[..., None])
        return training_batch(hand, seen, goals, self.size, seeded(self.seed, STREAM, number), NOISE)

    def _load(self, group: list[Sample], random: np.random.Generator) -> Picture:
        """A picture of the group; those that cannot be loaded are noted and passed over.

        Raises:
            InputError: too many of them one after the other.
        """
        reason = ""
        for _ in range(TRIES):
            sample = group[random.integers(len(group))]
            try:
                return load_picture(sample, self.models, int(self.size * SURROUNDINGS))
            except InputError as error:
                self.failed[sample.name] = reason = str(error)
        raise InputError(f"{TRIES} photos of {group[0].subject} could not be read, the last: {reason}")

    def _pictures(self, hand: HandModel, pictures: list[Picture]) -> DatasetPictures:
        poses = [in_camera(hand, picture) for picture in pictures]

        def stacked(tensors: list[Tensor]) -> Tensor:
            return torch.stack(tensors).float().to(self.device)

        angles, orientation, translation = (stacked([pose[k] for pose in poses]) for k in range(3))
        shape = stacked([torch.from_numpy(picture.mano.betas) for picture in pictures])
        image, K = stacked([p.image for p in pictures]), stacked([p.camera.K for p in pictures])
        mask = self._silhouettes(hand, (shape, angles, orientation, translation), K, image.shape[1])
        for k, picture in enumerate(pictures):
            if picture.mask is not None:
                mask[k] = picture.mask.to(mask)
        left = torch.zeros(len(image), dtype=torch.int64, device=self.device)
        return DatasetPictures(image, mask, mask, angles, orientation, translation, shape, K, left)

    def _silhouettes(self, hand: HandModel, pose: tuple[Tensor, ...], K: Tensor, size: int) -> Tensor:
        posed = pose_hands(hand, *pose).posed
        still = torch.eye(4, device=self.device).expand(len(posed), -1, -1)
        seen = depth_map(posed, hand.faces, still, K, size, size, outputs=["face_ids"], validate=False)
        return (seen.face_ids >= 0).float()


def in_camera(hand: HandModel, picture: Picture) -> HandPose:
    """The right hand's pose in the frame of the picture's camera."""
    pose, view = hand_pose_of_mano(hand, picture.mano), picture.camera.viewmat.double()
    turn, shift = view[:3, :3], view[:3, 3]
    return HandPose(pose.angles, turn @ pose.orientation, turn @ pose.translation + shift)


@dataclass(frozen=True, kw_only=True)
class MixedHands:
    """A `BatchSource` that takes each batch from a data set with a probability, else from synthetic people."""

    real: DatasetHands
    synthetic: SyntheticHands
    weight: float
    """Share of batches of the data set, 0 to 1."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[TrainingBatch]:
        """Endless batches; which source batch k is of depends on the seed and k alone."""
        before = sum(self._is_real(step * world + rank) for step in range(first_step))
        real, synthetic = self.real(before, rank, world), self.synthetic(first_step - before, rank, world)
        for number in itertools.count(first_step * world + rank, world):
            yield next(real if self._is_real(number) else synthetic)

    def _is_real(self, number: int) -> bool:
        return bool(np.random.default_rng([self.real.seed, MIX_STREAM, number]).random() < self.weight)
