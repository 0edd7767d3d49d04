"""Batches of a data set, and of a data set with synthetic people."""

import itertools
from typing import Any

import pytest
import torch
from datasets.trees import WRITERS

from oasis_warp.core.errors import InputError
from oasis_warp.datasets.readers import read_dataset
from oasis_warp.datasets.training_source import TRIES, DatasetHands, MixedHands
from oasis_warp.hand.mano import read_mano
from oasis_warp.ops import depth_map


@pytest.fixture(scope="module")
def models(mano_dir):
    return {side: read_mano(mano_dir, side) for side in ("right", "left")}


def source(name, root, models, mano, mano_dir, **options):
    WRITERS[name](root, models)
    settings = {"seed": 0, "hands": 2, "views": 2, "size": 96, "device": torch.device("cpu")} | options
    return DatasetHands(catalogue=read_dataset(name, root, mano_dir), models=models, hand=mano, **settings)


@pytest.mark.parametrize("name", ["hanco", "photos"])
def test_surfaces_of_a_batch_lie_on_its_pictures(name, models, mano, mano_dir, tmp_path):
    hands = source(name, tmp_path, models, mano, mano_dir)
    batch = next(hands(0, 0, 1))
    assert batch.image.shape == (2, 96, 96, 3) and batch.target_images.shape == (2, 2, 96, 96, 3)
    still = torch.eye(4).expand(2, -1, -1)
    seen = depth_map(batch.posed, mano.faces, still, batch.K, 96, 96).face_ids >= 0
    overlap = (seen & (batch.mask > 0.5)).sum((1, 2)) / (seen | (batch.mask > 0.5)).sum((1, 2))
    # Masks have an estimator's errors, and the tree draws the convex hull as HanCo's.
    assert (overlap > (0.5 if name == "hanco" else 0.75)).all()
    outside = batch.target_images * (batch.target_masks < 0.01)[..., None]
    assert float(outside.abs().max()) < 0.05


def test_batches_depend_on_their_number_alone_and_broken_photos_are_passed_over(models, mano, mano_dir, tmp_path):
    hands = source("hanco", tmp_path, models, mano, mano_dir, hands=1, views=1)
    batches = hands(0, 0, 1)
    first, second = next(batches), next(batches)
    again = next(hands(1, 0, 1))
    assert all(torch.equal(a, b) for a, b in zip(second, again, strict=True))
    assert not torch.equal(first.image, second.image)
    for sample in hands.catalogue.samples[::2]:
        sample.image.write_bytes(b"")
    for _ in range(4):
        next(batches)
    assert hands.failed and all("jpg" in reason for reason in hands.failed.values())
    for sample in hands.catalogue.samples:
        sample.image.write_bytes(b"")
    with pytest.raises(InputError, match=f"{TRIES} photos of 0.* could not be read, the last"):
        for _ in range(2):  # one batch was loaded ahead, perhaps before the photos were gone
            next(batches)


def test_a_mixture_takes_its_share_of_each_source_and_resumes_at_any_step():
    class Numbered:
        seed = 0

        def __init__(self, name):
            self.name = name

        def __call__(self, first_step, rank, world):
            while True:
                yield self.name, first_step * world + rank
                first_step += 1

    mixed: Any = MixedHands.__new__(MixedHands)
    for name, value in {"real": Numbered("real"), "synthetic": Numbered("synthetic"), "weight": 0.3}.items():
        object.__setattr__(mixed, name, value)
    whole = list(itertools.islice(mixed(0, 0, 1), 400))
    assert 90 < sum(name == "real" for name, _ in whole) < 150
    assert [number for name, number in whole if name == "real"][:3] == [0, 1, 2]
    for start in (1, 7, 50):
        assert next(mixed(start, 0, 1)) == whole[start]
