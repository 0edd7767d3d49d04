"""140 scenes of the seeded grid against the float64 references, and what a scene is."""

import math

import pytest
import torch

from oasis_warp import ops
from oasis_warp.certify.certification import EXACT_STIFF, check_scene, grid_scenes, run_grid
from oasis_warp.certify.compare import LAYER, Measurement, compare
from oasis_warp.certify.families import FAMILIES


@pytest.mark.parametrize("scenes", [20, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FAMILIES)
def test_float32_operators_keep_their_bounds_on_the_first_scenes_of_the_grid(name, scenes, device):
    measured = [m for seed in range(scenes) for m in check_scene(name, seed, device)]
    assert len(measured) > scenes
    assert not [m for m in measured if not m.passed]


SMALL = {"rasterization": {"n": 40, "size": (17, 15), "channels": 3, "mode": "RGB"}}


@pytest.mark.parametrize(
    "dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.slow)], ids=["float32", "float64"]
)
@pytest.mark.parametrize("name", FAMILIES)
def test_small_scenes_of_every_condition_equal_the_references(name, dtype, device):
    family = FAMILIES[name]
    for condition in family.conditions:
        for seed in (0, 1):
            case = family.case(condition, seed, **SMALL.get(name, {}))
            found = compare(family, case, dtype, device, EXACT_STIFF if dtype == torch.float64 else None)
            assert not [m for m in found if not m.passed]


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_float64_operators_are_exact_on_the_first_scenes_of_the_grid(name, device):
    family = FAMILIES[name]
    for seed in range(len(family.conditions)):
        measured = compare(family, family.scene(seed), torch.float64, device, EXACT_STIFF)
        assert not [m for m in measured if not m.passed]


@pytest.mark.parametrize("name", FAMILIES)
def test_a_scene_is_a_function_of_its_seed_alone(name):
    for seed in range(0, 40, 7):
        torch.manual_seed(0)
        first = FAMILIES[name].scene(seed)
        before = torch.get_rng_state()
        torch.manual_seed(1)
        second = FAMILIES[name].scene(seed)
        assert (
            str(first) == str(second)
            and first.differentiable == second.differentiable
            and first.bounds == second.bounds
        )
        assert first.floats.keys() == second.floats.keys()
        assert all(torch.equal(first.floats[k], second.floats[k]) for k in first.floats)
        assert all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
                   for a, b in ((first.others[k], second.others[k]) for k in first.others))  # fmt: skip
        torch.manual_seed(0)
        assert torch.equal(before, torch.get_rng_state()), "the global generator was used"


@pytest.mark.parametrize("name", FAMILIES)
def test_scenes_hold_float32_numbers_and_every_condition_has_its_turn(name):
    family = FAMILIES[name]
    cases = [family.scene(seed) for seed in range(len(family.conditions))]
    assert {case.condition for case in cases} == set(family.conditions)
    for case in cases:
        for tensor in case.floats.values():
            assert tensor.dtype == torch.float64 and torch.equal(tensor, tensor.float().double())


def test_scenes_are_shared_out_over_the_operators_with_consecutive_seeds():
    got = grid_scenes(("a", "b"), 5, seed=7)
    assert got == [("a", 7), ("b", 7), ("a", 8), ("b", 8), ("a", 9)]


def test_an_operator_that_raises_is_a_failure_and_not_the_end(monkeypatch):
    def broken(**_):
        raise RuntimeError("no such kernel")

    monkeypatch.setattr(ops, "face_rotations", broken)
    (found,) = check_scene("face_rotations", 4, torch.device("cpu"))
    assert not found.passed and "any unit of length, seed 4: RuntimeError: no such kernel" in found.scene


@pytest.mark.parametrize(
    ("break_it", "check"),
    [
        (lambda image: image * (1 + 3e-5), "values"),
        (lambda image: image + 1e-3 * (torch.arange(image.numel()).view_as(image) == 5), "single elements"),
        (lambda image: image.where(image != image.max(), math.nan), "not finite"),
        (lambda image: image + 1e-4 * (image - image.detach()), "gradients"),
    ],
)  # fmt: skip
def test_a_slightly_wrong_image_is_found(break_it, check, monkeypatch):
    right = ops.rasterization

    def wrong(**arguments):
        image, alphas, meta = right(**arguments)
        return break_it(image), alphas, meta

    monkeypatch.setattr(ops, "rasterization", wrong)
    case = FAMILIES["rasterization"].case("ordinary", 2, n=20, size=(17, 15))
    found = compare(FAMILIES["rasterization"], case, torch.float32, torch.device("cpu"))
    assert check in {m.check.removeprefix("float32 ") for m in found if not m.passed}


def test_nan_fails_every_bound():
    assert not Measurement("f", "c", "s", math.nan, 1.0).passed
    assert Measurement("f", "c", "s", math.nan, 1.0).load == math.inf
    assert LAYER > 1 / 255


@pytest.mark.slow
def test_processes_measure_what_one_process_measures():
    todo = grid_scenes(("pose_on_mesh", "face_rotations"), 44, 0)
    cpu = torch.device("cpu")
    alone = sorted(m for _, part in run_grid(todo, cpu, 1) for m in part)
    shared = list(run_grid(todo, cpu, 2))
    assert sum(n for n, _ in shared) == 44
    assert sorted(m for _, part in shared for m in part) == alone
