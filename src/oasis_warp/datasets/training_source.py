"""Batches of a data set for the prior's training, alone or mixed with synthetic people."""

import itertools
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.processes import worker_pool
from oasis_warp.core.types import HandPose, TrainingBatch
from oasis_warp.datasets.samples import Catalogue, Models, Sample, load_picture
from oasis_warp.hand.mano import ManoPose
from oasis_warp.hand.mano_hand import hand_pose_of_mano
from oasis_warp.ops import depth_map
from oasis_warp.pretraining.synthetic_source import SURROUNDINGS, SyntheticHands, seeded
from oasis_warp.pretraining.training_batch import EstimatorNoise, pose_hands, training_batch

STREAM, MIX_STREAM = 5, 6
"""Stream numbers of the choice of samples, and of data set or synthetic people, beside those of synthetic sources."""
TRIES = 20
"""Samples that cannot be loaded, one after the other, before a training ends."""
AHEAD = 2
"""Batches of each process that are loading or wait to be taken."""
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


class Loaded(NamedTuple):
    """A `Picture` of 8 bits a colour, as in the photo."""

    pixels: Tensor
    """[S, S, 4]: the image, and its mask where it `has_mask`."""
    has_mask: bool
    viewmat: np.ndarray
    K: np.ndarray
    mano: ManoPose


_own = threading.local()
"""`models` of a process or thread that loads pictures."""


def _keep_models(models: Models) -> None:
    _own.models = models


def _load(sample: Sample, models: Models, size: int, pixels: Tensor) -> Loaded:
    """As `load_picture`, into `pixels`."""
    image, mask, camera, mano = load_picture(sample, models, size)
    pixels[..., :3] = 255 * image + 0.5
    if mask is not None:
        pixels[..., 3] = 255 * mask + 0.5
    return Loaded(pixels, mask is not None, *map(np.asarray, camera[:2]), mano)


def _empty(count: int, size: int) -> Tensor:
    return torch.zeros(count, size, size, 4, dtype=torch.uint8)


def _load_all(samples: Sequence[Sample], size: int) -> tuple[list[Loaded | str], Tensor]:
    """Each sample's picture, or why it cannot be loaded; and the pixels of all, which these lack.

    Between processes torch shares one tensor by its memory; through a pipe the pixels would take longer than loading.
    """
    found: list[Loaded | str] = []
    pixels, nothing = _empty(len(samples), size), _empty(0, 0)
    for sample, own in zip(samples, pixels, strict=True):
        try:
            found.append(_load(sample, _own.models, size, own)._replace(pixels=nothing))
        except InputError as error:
            found.append(str(error))
    return found, pixels


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
    """Processes that load batches ahead; 0 for a thread of this one."""
    failed: dict[str, str] = field(default_factory=dict)
    """Samples that could not be loaded, with the reason; others took their place."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[TrainingBatch]:
        """Endless batches."""
        hand = self.hand.to(self.device)
        for number, photos, targets in self.loaded(first_step, rank, world):
            yield self._batch(hand, photos, targets, number)

    def loaded(self, first_step: int, rank: int, world: int) -> Iterator[tuple[int, list[Loaded], list[Loaded]]]:
        """Numbers of batches, their photos, and the targets of all photos in turn."""
        groups, size = self._groups(), int(self.size * SURROUNDINGS)
        keep, alone = partial(_keep_models, self.models), partial(cv2.setNumThreads, 1)
        pool = worker_pool(self.workers, keep, alone) if self.workers else ThreadPoolExecutor(1, initializer=keep)
        numbers = itertools.count(first_step * world + rank, world)
        waiting = deque[tuple[int, list[list[Sample]], Future[tuple[list[Loaded | str], Tensor]]]]()

        def submit() -> None:
            chosen = self._chosen(groups, number := next(numbers))
            waiting.append((number, chosen, pool.submit(_load_all, [group[0] for group in chosen], size)))

        with pool:
            for _ in range(max(1, AHEAD * self.workers)):
                submit()
            try:
                while True:
                    number, chosen, loading = waiting.popleft()
                    found = [
                        self._instead(group, pixels, picture) if isinstance(picture, str)
                        else picture._replace(pixels=pixels)
                        for group, picture, pixels in zip(chosen, *loading.result(), strict=True)
                    ]  # fmt: skip
                    submit()
                    photos = found[:: 1 + self.views]
                    yield number, photos, [each for k, each in enumerate(found) if k % (1 + self.views)]
            finally:
                for *_, loading in waiting:
                    loading.cancel()

    def _groups(self) -> list[list[Sample]]:
        """Samples of one hand of one person each."""
        table: dict[tuple[str, str], list[Sample]] = {}
        for sample in self.catalogue.samples:
            table.setdefault((sample.subject, sample.side), []).append(sample)
        return [table[key] for key in sorted(table)]

    def _chosen(self, groups: list[list[Sample]], number: int) -> list[list[Sample]]:
        """For each picture of a batch, those of its hand in the order in which they are tried."""
        random = np.random.default_rng([self.seed, STREAM, number])
        owners = [groups[random.integers(len(groups))] for _ in range(self.hands)]
        return [
            [group[k] for k in random.integers(len(group), size=TRIES)]
            for group in owners for _ in range(1 + self.views)
        ]  # fmt: skip

    def _instead(self, group: list[Sample], pixels: Tensor, reason: str) -> Loaded:
        """The next picture that can be loaded after the first, into `pixels`; others are noted.

        Raises:
            InputError: none can.
        """
        for failed, sample in itertools.pairwise(group):
            self.failed[failed.name] = reason
            try:
                return _load(sample, self.models, len(pixels), pixels)
            except InputError as error:
                reason = str(error)
        raise InputError(f"{TRIES} photos of {group[0].subject} could not be read, the last: {reason}")

    def _batch(self, hand: HandModel, photos: list[Loaded], targets: list[Loaded], number: int) -> TrainingBatch:
        seen, goals = (self._pictures(hand, pictures) for pictures in (photos, targets))
        goals = goals._replace(image=goals.image * goals.mask[..., None])
        return training_batch(hand, seen, goals, self.size, seeded(self.seed, STREAM, number), NOISE)

    def _pictures(self, hand: HandModel, pictures: list[Loaded]) -> DatasetPictures:
        poses = [in_camera(hand, picture.mano, torch.from_numpy(picture.viewmat)) for picture in pictures]

        def stacked(tensors: list[Tensor]) -> Tensor:
            return torch.stack(tensors).float().to(self.device)

        angles, orientation, translation = (stacked([pose[k] for pose in poses]) for k in range(3))
        shape = stacked([torch.from_numpy(picture.mano.betas) for picture in pictures])
        pixels = torch.stack([picture.pixels for picture in pictures]).to(self.device).float() / 255
        image = pixels[..., :3].contiguous()
        K = stacked([torch.from_numpy(p.K) for p in pictures])
        mask = self._silhouettes(hand, (shape, angles, orientation, translation), K, image.shape[1])
        for k, picture in enumerate(pictures):
            if picture.has_mask:
                mask[k] = pixels[k, ..., 3]
        left = torch.zeros(len(image), dtype=torch.int64, device=self.device)
        return DatasetPictures(image, mask, mask, angles, orientation, translation, shape, K, left)

    def _silhouettes(self, hand: HandModel, pose: tuple[Tensor, ...], K: Tensor, size: int) -> Tensor:
        posed = pose_hands(hand, *pose).posed
        eye = torch.eye(4, device=self.device).expand(len(posed), -1, -1)
        seen = depth_map(posed, hand.faces, eye, K, size, size, outputs=["face_ids"], validate=False)
        return (seen.face_ids >= 0).float()


def in_camera(hand: HandModel, mano: ManoPose, viewmat: Tensor) -> HandPose:
    """The right hand's pose in the frame of a camera, whose `viewmat` takes the world there."""
    pose, view = hand_pose_of_mano(hand, mano), viewmat.double()
    rotation, shift = view[:3, :3], view[:3, 3]
    return HandPose(pose.angles, rotation @ pose.orientation, rotation @ pose.translation + shift)


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
