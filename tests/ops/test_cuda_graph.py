"""CUDA graphs: the captured rasterizer gives the bits of the eager one, and memory for pairs suffices or is missed."""

import pytest
import torch
from rasterization_scenes import ordinary_scene

from oasis_warp.ops import RecordedRasterization, rasterization
from oasis_warp.ops._runtime import pair_counts
from oasis_warp.ops._runtime.pair_counts import Counts


def arguments_of(scene):
    return [
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks,
        scene.backgrounds,
    ]  # fmt: skip


def eager(tensors, scene):
    *drawn, backgrounds = tensors
    return rasterization(*drawn, scene.width, scene.height, backgrounds=backgrounds, validate=False)[:2]


def leaves_of(scene, needs=(0, 1, 2, 3, 4, 5, 7)):
    return [t.clone().requires_grad_(k in needs) for k, t in enumerate(arguments_of(scene))]


def gradients(outputs, leaves, weights):
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    return [g.clone() for g in torch.autograd.grad(outputs, wanted, weights)]


def assert_equals_eager_call(draw, scene):
    """Images and gradients of a random sum, to the bit."""
    recorded, plain = leaves_of(scene), leaves_of(scene)
    got, want = draw(*recorded), eager(plain, scene)
    weights = [torch.randn_like(o) for o in want]
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
    found, expected = gradients(got, recorded, weights), gradients(want, plain, weights)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_what_cannot_be_recorded_is_refused():
    scene = ordinary_scene(0)
    with pytest.raises(ValueError, match=r"means: expected float32 on a CUDA device, got torch.float32 on cpu"):
        RecordedRasterization(scene.width, scene.height)(*arguments_of(scene))


@pytest.mark.gpu
def test_pictures_and_gradients_have_the_bits_of_eager_calls_for_any_values():
    scenes = [ordinary_scene(seed, device="cuda") for seed in range(3)]
    draw = RecordedRasterization(scenes[0].width, scenes[0].height)
    for scene in scenes:
        assert_equals_eager_call(draw, scene)


@pytest.mark.gpu
def test_a_gradient_that_does_not_come_counts_as_zero_also_after_one_that_did():
    scene = ordinary_scene(1, device="cuda")
    draw = RecordedRasterization(scene.width, scene.height)
    for which in ((0, 1), (0,), (1,), (0,)):
        recorded, plain = leaves_of(scene), leaves_of(scene)
        got, want = draw(*recorded), eager(plain, scene)
        found, expected = (
            torch.autograd.grad([out[k].sum() for k in which], leaves[0])[0]
            for out, leaves in ((got, recorded), (want, plain))
        )
        assert torch.equal(found, expected), which


@pytest.mark.gpu
def test_more_pairs_than_were_recorded_are_drawn_exactly_and_recorded_anew():
    scene = ordinary_scene(2, n=4000, width=64, height=64, size=(0.002, 0.004), device="cuda")
    large = scene.with_(scales=scene.scales * 60)
    draw = RecordedRasterization(scene.width, scene.height)
    for which in (scene, large, large, scene):
        assert_equals_eager_call(draw, which)


@pytest.mark.gpu
def test_other_shapes_and_needs_are_recorded_anew():
    first, second = (ordinary_scene(3, n=n, device="cuda") for n in (60, 50))
    draw = RecordedRasterization(first.width, first.height)
    for scene, needs in ((first, (0,)), (second, (0,)), (second, (4,)), (second, ()), (first, (0, 4))):
        leaves = leaves_of(scene, needs)
        got, want = draw(*leaves), eager(leaves, scene)
        assert all(torch.equal(a, b) and a.requires_grad == bool(needs) for a, b in zip(got, want, strict=True))


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
    slots.release(taken[7])
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
