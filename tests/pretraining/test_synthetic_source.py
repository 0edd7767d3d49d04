"""The synthetic world as a source of batches: which pictures come in which batch, and that they are always the same."""

import itertools
from collections import Counter
from dataclasses import replace

import pytest
import torch

from oasis_warp.pretraining.pretrain import BatchSource
from oasis_warp.pretraining.synthetic_source import EVEN_EVERY, SyntheticHands
from oasis_warp.synthetic.shots import EVERYBODY, PICTURES_EACH

CPU = torch.device("cpu")
BARE = replace(EVERYBODY, tattoo=0.0, ring=0.0)


def source(**changes):
    usual = {"seed": 13, "people": 1, "hands": 1, "views": 2, "size": 32, "device": CPU, "population": BARE}
    return SyntheticHands(**usual | changes)


def test_a_batch_is_the_same_wherever_training_is_taken_up():
    hands = source()
    assert isinstance(hands, BatchSource)
    from_start = hands(0, 0, 1)
    first, second = next(from_start), next(from_start)
    others = {
        "taken up": next(hands(1, 0, 1)),
        "of another process": next(hands(0, 1, 2)),
        "rendered with the one before": next(itertools.islice(source(ahead=2)(0, 0, 1), 1, None)),
        "rendered with the one after": next(source(ahead=2)(1, 0, 1)),
    }
    for name, value in second._asdict().items():
        for where, other in others.items():
            assert torch.equal(value, getattr(other, name)), (where, name)
        assert bool(value.isfinite().all()), name
    assert not torch.equal(first.image, second.image)
    assert second.image.shape == (1, 32, 32, 3)
    assert second.target_images.shape == (1, 2, 32, 32, 3)


def test_targets_show_the_hands_of_the_photos():
    hands = source(hands=3, views=2)
    photos, targets = hands.photo_indices(5), hands.target_indices(5)
    assert len(set(targets)) == 6
    assert [index // PICTURES_EACH for index in targets] == [p // PICTURES_EACH for p in photos for _ in range(2)]


def test_now_and_then_photos_are_in_the_even_light_of_their_targets_before_a_plain_wall():
    batches = source()(2 * EVEN_EVERY - 2, 0, 1)
    in_a_room, evenly_lit = next(batches), next(batches)

    def alike(batch):
        """Share of the border, part of which is the arm, in one colour."""
        image = batch.image[0]
        border = torch.cat([image[0], image[-1], image[:, 0], image[:, -1]])
        return float(((border - border.median(0).values).abs().amax(1) < 1e-3).float().mean())

    assert alike(evenly_lit) > 0.5 and alike(in_a_room) < 0.2
    hand = evenly_lit.mask[0] > 0.9
    shown, target = evenly_lit.image[0][hand].mean(0), evenly_lit.target_images[0, 0]
    goal = target[evenly_lit.target_masks[0, 0] > 0.9].mean(0)
    torch.testing.assert_close(shown, goal, atol=0.03, rtol=0)


def test_all_processes_together_see_every_picture_once():
    hands = source(hands=3)
    seen = Counter(p for step in range(4) for rank in range(2) for p in hands.photo_indices(2 * step + rank))
    assert sorted(seen) == [PICTURES_EACH * k for k in range(24)] and set(seen.values()) == {1}


@pytest.mark.parametrize(("people", "hands", "world", "steps"), [(12, 3, 2, 50), (7, 2, 3, 50), (100, 4, 2, 3)])
def test_each_process_meets_whom_its_batches_show(people, hands, world, steps):
    made = source(people=people, hands=hands)
    for rank in range(world):
        shown = {
            index // PICTURES_EACH % people
            for step in range(steps)
            for index in made.photo_indices(step * world + rank)
        }
        met = made.people_met(rank, world, steps)
        assert set(met) == shown and len(met) == len(shown)


def test_the_errors_of_an_estimator_differ_from_batch_to_batch_and_seed_to_seed():
    drawn = [float(torch.rand((), generator=s.errors(n))) for s in (source(), source(seed=14)) for n in (0, 1)]
    assert len(set(drawn)) == 4
    assert drawn[0] == float(torch.rand((), generator=source().errors(0)))


def test_a_kind_that_is_held_out_is_not_shown_and_nothing_else_changes():
    kinds = BARE, replace(BARE, ring=1.0)
    without, with_ring = (next(source(population=each, views=1)(0, 0, 1)) for each in kinds)
    assert torch.equal(without.rest, with_ring.rest) and torch.equal(without.target_posed, with_ring.target_posed)
    assert not torch.equal(without.target_images, with_ring.target_images)
