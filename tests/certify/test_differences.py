"""Finite differences: they accept the operators and the twins, and catch a gradient that is a little wrong."""

import dataclasses

import pytest
import torch

from oasis_warp import ops
from oasis_warp.certify.certification import small_scenes
from oasis_warp.certify.differences import finite_differences
from oasis_warp.certify.families import FAMILIES

CPU = torch.device("cpu")
DIFFERENTIABLE = [name for name, family in FAMILIES.items() if next(iter(small_scenes(family, 0)), None)]
pytestmark = pytest.mark.usefixtures("as_shipped")  # thousands of small calls, and the checks cost more than they do


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
    for wrong in case.wanted:
        with monkeypatch.context() as patch:
            patch.setattr(
                ops, name, lambda wrong=wrong, **given: right(**given | {wrong: Scaled.apply(given[wrong], 1 + 1e-6)})
            )
            found = finite_differences(family, case, CPU, n_directions=2)
        assert [m.scene.split(": ")[1] for m in found if not m.passed] == [wrong]


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_of_the_twins_are_those_of_finite_differences(name):
    family = FAMILIES[name]

    class Twin:
        """The twin in the operator's place."""

        def __getattr__(self, attribute):
            return getattr(family, attribute)

        def call(self, arguments):
            return {k: v for k, v in arguments.items() if k != "validate"}

        def read(self, arguments):
            return family.twin(case, arguments, 1.0)[0]

    for case in small_scenes(family, 3):
        for m in finite_differences(Twin(), case, CPU, n_directions=1):
            assert m.passed, m


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_scenes_for_differences_are_smooth_and_ask_for_every_input(name):
    family = FAMILIES[name]
    cases = list(small_scenes(family, 0))
    assert all(family.smooth(case) for case in cases)
    floats = {key for case in cases for key in case.wanted}
    assert floats == {key for seed in range(60) for key in family.scene(seed).wanted}


def test_a_swap_of_two_layers_is_not_smooth():
    family = FAMILIES["rasterization"]
    case = next(small_scenes(family, 0))
    means = case.floats["means"].clone()
    means[1] = means[0]
    assert not family.smooth(dataclasses.replace(case, floats=case.floats | {"means": means}))
