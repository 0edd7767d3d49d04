"""The recorded rasterizer gives the bits of the eager one, whatever comes after what was recorded."""

import pytest
import torch
from rasterization_scenes import ordinary_scene

from oasis_warp.ops import RecordedRasterization, rasterization


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


def test_what_cannot_be_recorded_is_refused():
    scene = ordinary_scene(0)
    with pytest.raises(ValueError, match=r"means: expected float32 on a CUDA device, got torch.float32 on cpu"):
        RecordedRasterization(scene.width, scene.height)(*arguments_of(scene))


@pytest.mark.gpu
def test_pictures_and_gradients_have_the_bits_of_eager_calls_for_any_values():
    draw = None
    for seed in range(3):
        scene = ordinary_scene(seed, device="cuda")
        draw = draw or RecordedRasterization(scene.width, scene.height)
        recorded, plain = leaves_of(scene), leaves_of(scene)
        got, want = draw(*recorded), eager(plain, scene)
        weights = [torch.randn_like(o) for o in want]
        assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
        found, expected = gradients(got, recorded, weights), gradients(want, plain, weights)
        assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


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
        recorded, plain = leaves_of(which), leaves_of(which)
        got, want = draw(*recorded), eager(plain, which)
        assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
        weights = [torch.ones_like(o) for o in want]
        found, expected = gradients(got, recorded, weights), gradients(want, plain, weights)
        assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.gpu
def test_other_shapes_and_needs_are_recorded_anew():
    first, second = (ordinary_scene(3, n=n, device="cuda") for n in (60, 50))
    draw = RecordedRasterization(first.width, first.height)
    for scene, needs in ((first, (0,)), (second, (0,)), (second, (4,)), (second, ()), (first, (0, 4))):
        leaves = leaves_of(scene, needs)
        got, want = draw(*leaves), eager(leaves, scene)
        assert all(torch.equal(a, b) and a.requires_grad == bool(needs) for a, b in zip(got, want, strict=True))
