"""The operators pass the checks, and each check finds what it looks for."""

import dataclasses

import pytest
import torch

from oasis_warp import ops
from oasis_warp.certify.certification import (
    bit_differences,
    finite_differences,
    full_scene,
    outputs_and_gradients,
    refusals,
    small_scenes,
)
from oasis_warp.certify.families import FAMILIES
from oasis_warp.reference.errors import same_bits

CPU = torch.device("cpu")
DIFFERENTIABLE = [name for name, family in FAMILIES.items() if next(iter(small_scenes(family, 0)), None)]
pytestmark = pytest.mark.usefixtures(
    "as_shipped"
)  # thousands of small calls, and the type checks cost more than they do


@pytest.mark.parametrize("repeats", [5, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FAMILIES)
def test_repeats_on_one_two_and_three_threads_give_the_same_bits(name, repeats, device):
    family = FAMILIES[name]
    found = bit_differences(family, family.case("ordinary", 1, **family.large), device, repeats)
    assert [m.scene.split(": ")[1] for m in found] == [f"{repeats} runs on {n} threads" for n in (1, 2, 3)]
    assert not [m for m in found if not m.passed]


@pytest.mark.parametrize("name", FAMILIES)
def test_other_calls_in_between_change_no_bit(name, device):
    family = FAMILIES[name]
    case, others = family.case("ordinary", 1, **family.large), [family.scene(seed) for seed in range(12)]
    first = outputs_and_gradients(family, case, device)
    for other in others:
        outputs_and_gradients(family, other, device)
        assert same_bits(first, outputs_and_gradients(family, case, device))


def fill_freed_memory(value):
    """Fill memory with `value` and free it: the next call gets some of it."""
    sizes = [2**k * m for k in range(15) for m in (1, 3, 9)]
    _ = [torch.full((size,), value) for size in sizes for _ in range(3)]


@pytest.mark.parametrize("name", FAMILIES)
def test_results_do_not_depend_on_what_memory_held_before(name):
    family = FAMILIES[name]
    for seed in range(45):
        case = family.scene(seed)
        fill_freed_memory(3e37)
        first = outputs_and_gradients(family, case, CPU)
        fill_freed_memory(-7.0)
        assert same_bits(first, outputs_and_gradients(family, case, CPU)), case


def test_one_bit_in_one_gradient_is_found(monkeypatch):
    family, calls = FAMILIES["pose_on_mesh"], []
    right = ops.pose_on_mesh

    def drifting(**arguments):
        calls.append(None)
        arguments["scales"] = arguments["scales"] * (1 + 6e-8 * (len(calls) > 3))
        return right(**arguments)

    monkeypatch.setattr(ops, "pose_on_mesh", drifting)
    found = bit_differences(family, family.case("ordinary", 0, n=7), CPU, 5)
    assert [m.error for m in found] == [3.0, 5.0, 5.0]


class Scaled(torch.autograd.Function):
    """The identity, with a derivative of `factor`."""

    @staticmethod
    def forward(ctx, tensor, factor):
        ctx.factor = factor
        return tensor.clone()

    @staticmethod
    def backward(ctx, grad):
        return ctx.factor * grad, None


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_a_gradient_that_is_off_by_a_millionth_is_found_and_no_other(name, monkeypatch):
    family = FAMILIES[name]
    case = next(small_scenes(family, 0))
    right = getattr(ops, name)
    for wrong in case.differentiable:
        with monkeypatch.context() as patch:
            patch.setattr(
                ops, name, lambda wrong=wrong, **given: right(**given | {wrong: Scaled.apply(given[wrong], 1 + 1e-6)})
            )
            found = finite_differences(family, case, CPU, n_directions=2)
        assert [m.scene.split(": ")[1] for m in found if not m.passed] == [wrong]


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_of_the_references_are_those_of_finite_differences(name):
    family = FAMILIES[name]

    class Reference:
        """The reference in the operator's place."""

        def __getattr__(self, attribute):
            return getattr(family, attribute)

        def call(self, arguments):
            return {k: v for k, v in arguments.items() if k != "validate"}

        def read(self, arguments):
            return family.reference(arguments, 1.0)[0]

    for case in small_scenes(family, 3):
        for m in finite_differences(Reference(), case, CPU, n_directions=1):
            assert m.passed, m


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_scenes_for_differences_are_smooth_and_cover_every_input(name):
    family = FAMILIES[name]
    cases = list(small_scenes(family, 0))
    assert all(family.smooth(case) for case in cases)
    floats = {key for case in cases for key in case.differentiable}
    assert floats == {key for seed in range(60) for key in family.scene(seed).differentiable}


def test_a_swap_of_two_layers_is_not_smooth():
    family = FAMILIES["rasterization"]
    case = next(small_scenes(family, 0))
    means = case.floats["means"].clone()
    means[1] = means[0]
    assert not family.smooth(dataclasses.replace(case, floats=case.floats | {"means": means}))


@pytest.mark.parametrize("name", FAMILIES)
def test_bad_values_shapes_and_indices_are_refused_by_name(name, device):
    family = FAMILIES[name]
    found = refusals(family, full_scene(family, 0), device)
    assert {m.check.split(" not ")[0] for m in found} >= {"NaN or Inf", "wrong shapes"}
    assert not [m for m in found if not m.passed]


def test_an_operator_that_does_not_check_values_is_found(monkeypatch):
    family = FAMILIES["face_rotations"]
    right = ops.face_rotations
    monkeypatch.setattr(ops, "face_rotations", lambda **given: right(**given, validate=False))
    found = refusals(family, full_scene(family, 0), CPU)
    assert sum(not m.passed for m in found if m.check.startswith("NaN")) == 6


@pytest.mark.parametrize("options", [{"mode": "D"}, {"mode": "RGB", "sh_degree": 2}])
def test_colors_that_are_not_numbers_are_refused_by_name_in_every_mode(options):
    family = FAMILIES["rasterization"]
    case = family.case("ordinary", 0, n=5, size=(5, 4), channels=3, **options)
    bad = case.floats["colors"].clone()
    bad.view(-1)[0] = torch.nan
    with pytest.raises(ValueError, match="^colors: "):
        family.call(case.arguments(torch.float32, CPU) | {"colors": bad.float()})
