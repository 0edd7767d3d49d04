"""The same bits forwards and backwards, however often and on however many threads."""

import pytest
import torch

from oasis_warp import ops
from oasis_warp.certify.determinism import differing, everything, same_bits
from oasis_warp.certify.families import FAMILIES


@pytest.mark.parametrize("repeats", [17, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FAMILIES)
def test_repeats_on_one_two_and_three_threads_give_the_same_bits(name, repeats, device):
    family = FAMILIES[name]
    case = family.case("ordinary", 1, **family.large)
    found = differing(family, case, device, repeats)
    assert [m.scene.split(": ")[1] for m in found] == [f"{repeats} runs on {n} threads" for n in (1, 2, 3)]
    assert not [m for m in found if not m.passed]


@pytest.mark.parametrize("name", FAMILIES)
def test_other_calls_in_between_change_no_bit(name, device):
    family = FAMILIES[name]
    case, others = family.case("ordinary", 1, **family.large), [family.scene(seed) for seed in range(12)]
    first = everything(family, case, device)
    for other in others:
        everything(family, other, device)
        assert all(map(same_bits, first, everything(family, case, device)))


def leave_behind(value):
    """Fill memory with `value` and give it back: the next call is given some of it."""
    sizes = [2**k * m for k in range(15) for m in (1, 3, 9)]
    _ = [torch.full((size,), value) for size in sizes for _ in range(3)]


@pytest.mark.parametrize("name", FAMILIES)
def test_nothing_shows_of_what_memory_held_before(name):
    family = FAMILIES[name]
    for seed in range(45):
        case = family.scene(seed)
        leave_behind(3e37)
        first = everything(family, case, torch.device("cpu"))
        leave_behind(-7.0)
        assert all(map(same_bits, first, everything(family, case, torch.device("cpu")))), case


def test_one_bit_in_one_gradient_is_found(monkeypatch):
    family, calls = FAMILIES["pose_on_mesh"], []
    right = ops.pose_on_mesh

    def drifting(**arguments):
        calls.append(None)
        arguments["scales"] = arguments["scales"] * (1 + 6e-8 * (len(calls) > 3))
        return right(**arguments)

    monkeypatch.setattr(ops, "pose_on_mesh", drifting)
    found = differing(family, family.case("ordinary", 0, n=7), torch.device("cpu"), 5)
    assert [m.error for m in found] == [3.0, 5.0, 5.0]
