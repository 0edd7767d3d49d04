"""The torch peers are judged by the float64 kernels and the other way round: neither shares code with the other."""

from dataclasses import replace

import pytest
import torch

from oasis_warp.bench import scenes
from oasis_warp.bench.operators import OPERATORS, draw_in_torch, exact, forward, with_gradients
from oasis_warp.reference.errors import psnr, relative_error
from oasis_warp.reference.rasterization import Rules


@pytest.fixture(scope="module")
def hand():
    return scenes.hand_scenes(size=48)


def agree(name, scene, values=1e-12, slopes=1e-11):
    operator, truth = OPERATORS[name], exact(OPERATORS[name], scene)
    wide = operator.prepare(scene.to(dtype=torch.float64))
    outputs = operator.comparable(forward(operator.torch_call, wide, {}))
    for ours, theirs in zip(truth.values, outputs, strict=True):
        assert relative_error(theirs, ours) <= values
    if operator.leaves:
        found = with_gradients(operator, operator.torch_call, wide, {}, truth.weights)().gradients
        for ours, theirs in zip(truth.gradients, found, strict=True):
            assert relative_error(theirs, ours) <= slopes


@pytest.mark.parametrize("make", [scenes.layered, scenes.needles, scenes.opaque, scenes.equal_depths])
def test_kernels_and_torch_draw_the_same_stiff_scenes(make):
    # A needle's determinant cancels 11 digits in the torch peer's gradient.
    agree("rasterization", make(size=32), values=1e-8, slopes=1e-5)


def test_kernels_and_torch_draw_the_same_hand(hand):
    agree("rasterization", hand[0])
    agree("blend_weights", hand[0])
    agree("blend_colors", hand[0])


@pytest.mark.parametrize("name", ["face_rotations", "pose_on_mesh", "posing"])
def test_kernels_and_torch_pose_the_same(hand, name):
    agree(name, hand[1])


@pytest.mark.parametrize("name", ["depth_map", "depth_visibility"])
def test_kernels_and_torch_see_the_same(hand, name):
    # A triangle of the hand is a thousandth of its distance: torch's cross products of corners cancel some digits.
    agree(name, hand[1], values=1e-5, slopes=1e-5)


@pytest.mark.parametrize(
    ("rules", "decibels"),
    [
        (Rules(transmittance_stop=1e-2), (42, 50)),
        (Rules(transmittance_stop=1e-3), (60, 72)),
        (Rules(alpha_min=2 / 255), (51, 58)),
        (Rules(alpha_min=4 / 255), (44, 50)),
        (Rules(extent_sigmas=3.0), (58, 66)),
        (Rules(extent_sigmas=2.5), (43, 50)),
        (Rules(extent_sigmas=2.0), (32, 38)),
    ],
)
def test_a_coarser_threshold_costs_what_theory_says(rules, decibels):
    # A layer below the cut has at most alpha 4/255; the tail beyond k sigma at most exp(-k^2/2): 1 to 14 % of a layer.
    scene = scenes.layered().to(dtype=torch.float64)
    low, high = decibels
    assert low <= psnr(draw_in_torch(scene, rules).image, draw_in_torch(scene).image) <= high


def test_fragile_pixels_are_those_where_float32_may_decide_otherwise():
    scene = scenes.frontal(
        "one", 0, torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1),
        torch.tensor([1.0]), torch.ones(1, 3), 32,
    ).to(dtype=torch.float64)  # fmt: skip
    # The opacity is chosen so that the alpha of one pixel lies on the cut, and then a hundredth beside it.
    alpha = draw_in_torch(replace(scene, opacities=scene.opacities * 0.5)).alphas[0, 10, 10, 0] * 2
    on_the_cut = float(Rules().alpha_min / alpha)
    for factor, fragile in ((1.0, True), (1.01, False), (0.99, False)):
        drawn = draw_in_torch(replace(scene, opacities=scene.opacities * on_the_cut * factor))
        assert bool(drawn.fragile[0, 10, 10]) == fragile


def test_an_empty_view_is_background():
    scene = scenes.layered(n=5, size=16)
    behind = replace(scene, means=-scene.means)
    drawn = draw_in_torch(behind)
    assert torch.equal(drawn.image, scene.backgrounds[0].expand(1, 16, 16, 3))
    assert not drawn.alphas.any()
    assert not drawn.fragile.any()
