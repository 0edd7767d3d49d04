"""What a captured rasterization may count on."""

import pytest
import torch

from oasis_warp.ops._runtime import pair_counts
from oasis_warp.ops._runtime.pair_counts import Counts


@pytest.fixture
def slots(monkeypatch):
    """Slots of ordinary memory: page-locked memory needs a device."""
    plain = torch.zeros
    monkeypatch.setattr(torch, "zeros", lambda *size, pin_memory, **options: plain(*size, **options))
    fresh = pair_counts._Slots()
    monkeypatch.setattr(pair_counts, "slots", fresh)
    return fresh


def test_a_slot_is_nobody_elses_until_it_is_given_back(slots):
    taken = [slots.take() for _ in range(3000)]  # more than a page
    assert len({slot.data_ptr() for slot in taken}) == len(taken)
    slots.give(taken[7])
    assert slots.take() is taken[7]


def test_an_eager_call_leaves_slots_for_a_capture(slots, monkeypatch):
    monkeypatch.setattr(pair_counts, "_last", {})
    pair_counts.remember((torch.device("cuda", 0), 1, 10, 8, 8), Counts(100, 20))
    assert slots.free


@pytest.mark.parametrize(("longest", "can_be_sorted"), [(20, 512), (341, 512), (342, 2048), (1400, 2**31 - 1)])
def test_a_capture_has_room_for_half_as_much_again(longest, can_be_sorted, slots, monkeypatch):
    kind = (torch.device("cuda", 0), 1, 10, 8, 8)
    monkeypatch.setattr(pair_counts, "_last", {kind: Counts(1000, longest)})
    assert pair_counts.capacity_of(kind, 1.5) == Counts(1500 + 4096, can_be_sorted)


def test_a_capture_without_an_eager_call_or_a_watcher_is_refused():
    kind = (torch.device("cuda", 0), 3, 123_457, 8, 8)
    with pytest.raises(RuntimeError, match="expected an eager call before it is captured"):
        pair_counts.capacity_of(kind, 1.5)
    with pytest.raises(RuntimeError, match="watch_overflow"):
        pair_counts.watching()


def test_a_watcher_learns_of_too_many_pairs_and_of_lists_too_long(slots, monkeypatch):
    kind = (torch.device("cuda", 0), 1, 10, 8, 8)
    monkeypatch.setattr(pair_counts, "_last", {kind: Counts(1000, 20)})
    with pair_counts.watch_overflow() as overflow:
        slot, capacity = pair_counts.watching().expect(kind)
    for pairs, longest, happened in ((capacity.pairs, 512, False), (capacity.pairs + 1, 9, True), (9, 513, True)):
        slot[0], slot[1] = pairs, longest
        assert overflow.happened() is happened
