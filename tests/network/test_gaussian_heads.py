import math
from dataclasses import replace

import pytest
import torch

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.anchors import OPACITY
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core import rotation
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.errors import InputError
from oasis_warp.evaluation.methods import prior_guess
from oasis_warp.network.heads import (
    FACE_LIMITS,
    FACE_OUTPUTS,
    MAX_OFFSET,
    TRUST,
    VERTEX_LIMITS,
    VERTEX_OUTPUTS,
    FeatureOnMesh,
    GaussianHead,
    cache_head,
    decode,
    decode_colors,
    decode_offsets,
    head_colors,
    zero_updates,
)
from oasis_warp.network.prior import NetworkPrior, guess_with_heads

FACES = torch.tensor([[0, 1, 2], [2, 1, 3]])


@pytest.fixture
def anchors(random):
    quats = torch.randn(1, 5, 4, generator=random)
    return {
        "quats": quats / quats.norm(dim=-1, keepdim=True),
        "scales": 0.001 + 0.001 * torch.rand(1, 5, 3, generator=random),
        "fade": torch.tensor([[1.0, 1.0, 0.5, 0.01, 0.0]]),
        "colors": torch.rand(1, 5, 3, generator=random) * 0.8 + 0.1,
        "seen": None,
        "limits": VERTEX_LIMITS,
    }


def raw_outputs(scale, random):
    return {name: scale * torch.randn(1, 5, size, generator=random) for name, size in VERTEX_OUTPUTS.items()}


@pytest.mark.parametrize("outputs", [VERTEX_OUTPUTS, FACE_OUTPUTS], ids=["vertices", "faces"])
def test_an_untrained_head_says_nothing_and_can_learn(outputs, random):
    head, features = GaussianHead(16, 8, outputs), torch.randn(2, 5, 16, generator=random)
    raw = head(features)
    assert {name: tensor.shape[-1] for name, tensor in raw.items()} == outputs
    assert not any(tensor.any() for tensor in raw.values())
    sum(tensor.sum() for tensor in raw.values()).backward()
    assert head.last.weight.grad is not None and head.last.weight.grad.any()


def test_outputs_stay_in_float32_under_autocast(random):
    head = GaussianHead(16, 8, VERTEX_OUTPUTS)
    with torch.autocast("cpu", torch.bfloat16):
        assert head(torch.randn(1, 3, 16, generator=random))["colors"].dtype == torch.float32


@pytest.mark.parametrize("limits", [VERTEX_LIMITS, FACE_LIMITS], ids=["vertices", "faces"])
def test_no_output_leaves_the_anchors_as_they_are(limits, anchors, random):
    same = decode(raw_outputs(0.0, random), **{**anchors, "limits": limits})
    torch.testing.assert_close(same.quats, anchors["quats"])
    torch.testing.assert_close(same.scales, anchors["scales"])
    torch.testing.assert_close(same.opacities, OPACITY * anchors["fade"])
    torch.testing.assert_close(same.colors, anchors["colors"])


@pytest.mark.parametrize("limits", [VERTEX_LIMITS, FACE_LIMITS], ids=["vertices", "faces"])
def test_any_output_gives_gaussians_that_can_be_drawn(limits, anchors, random):
    raw = raw_outputs(50.0, random)
    out = decode(raw, **{**anchors, "limits": limits})
    ratio = out.scales / anchors["scales"]
    assert bool((ratio > 0.999 / torch.tensor(limits.shrink)).all()) and float(ratio.max()) < 1.001 * limits.growth
    torch.testing.assert_close(out.quats.norm(dim=-1), torch.ones(1, 5))
    assert bool((out.opacities <= anchors["fade"]).all())
    assert bool((out.opacities >= limits.opacity * anchors["fade"]).all())
    assert float(out.colors.min()) >= 0 and float(out.colors.max()) <= 1
    assert float(decode_offsets(raw).abs().max()) <= MAX_OFFSET + 1e-9


def test_what_was_seen_comes_in_by_the_share_that_is_trusted(anchors, random):
    photo = torch.rand(1, 5, 3, generator=random) * 0.8 + 0.1
    seen = torch.logit(photo) - torch.logit(anchors["colors"])
    raw = {**raw_outputs(0.0, random), "trust": torch.tensor([[[0.0], [1], [0], [1], [0.5]]])}
    colors = decode(raw, **{**anchors, "seen": seen}).colors
    torch.testing.assert_close(colors[:, 0::2][:, :2], anchors["colors"][:, 0::2][:, :2])
    torch.testing.assert_close(colors[:, 1::2], photo[:, 1::2])
    assert bool(((colors[0, 4] - photo[0, 4]) * (colors[0, 4] - anchors["colors"][0, 4]) < 0).all())


def test_a_turn_is_in_the_frame_of_the_anchor(anchors, random):
    raw = raw_outputs(0.0, random)
    raw["quats"][..., 3] = 1.0  # (1, 0, 0, 1): a quarter turn about the anchor's own z axis
    out = rotation.to_matrix(decode(raw, **anchors).quats)
    before = rotation.to_matrix(anchors["quats"])
    torch.testing.assert_close(out[..., :, 2], before[..., :, 2], atol=1e-6, rtol=0)
    torch.testing.assert_close(out[..., :, 0], before[..., :, 1], atol=1e-6, rtol=0)


def test_a_face_starts_at_its_centroid_and_mixes_within_its_corners(random):
    mesh, features = FeatureOnMesh(2), torch.randn(1, 4, 6, generator=random)
    torch.testing.assert_close(mesh(features, FACES), features[:, FACES].mean(2))
    with torch.no_grad():
        mesh.logits[0] = torch.tensor([math.log(2.0), 0.0, math.log(5.0)])
    expected = (2 * features[:, 0] + features[:, 1] + 5 * features[:, 2]) / 8
    torch.testing.assert_close(mesh(features, FACES)[:, 0], expected)
    constant = torch.full((1, 4, 6), 0.7)
    torch.testing.assert_close(mesh(constant, FACES), torch.full((1, 2, 6), 0.7))


def test_barycentrics_and_features_learn(random):
    mesh, features = FeatureOnMesh(2), torch.randn(1, 4, 6, generator=random, requires_grad=True)
    loss = mesh(features, FACES).square().sum()
    for gradient in torch.autograd.grad(loss, (mesh.logits, features)):
        assert gradient.any(dim=-1).all()


LORA = AdaptConfig(texture="lora", lora_rank=4, texture_steps=4, reference_views=2)


@pytest.fixture(scope="module")
def case(network, crops):
    return crops[0], *guess_with_heads(NetworkPrior(network), crops[0])


def updates_of(heads, rank, random):
    return [zero_updates(head, rank, random) for head in heads]


def test_asking_for_the_heads_changes_no_gaussian_on_a_face_and_they_say_its_colours(case, network, random):
    crop, guess, heads = case
    alone = NetworkPrior(network)(crop)
    for name in ("face_index", "barycentrics"):
        torch.testing.assert_close(getattr(guess, name), getattr(alone, name), atol=1e-6, rtol=0)
    for name in ("quats", "scales", "opacities", "colors"):
        asked, without = (getattr(own, name)[len(own.vertex_index) :] for own in (guess, alone))
        torch.testing.assert_close(asked, without, atol=1e-6, rtol=0)
    own = [head_colors(*pair) for pair in zip(heads, updates_of(heads, 3, random), strict=True)]
    torch.testing.assert_close(torch.cat(own).detach(), guess.colors, atol=2e-6, rtol=0)


@pytest.mark.parametrize("switch", [{"fom": "off"}, {"point_evidence": "off"}])
def test_networks_without_a_part_have_heads_too(make_network, tiny, crops, random, switch):
    guess, heads = guess_with_heads(NetworkPrior(make_network(replace(tiny, **switch))), crops[0])
    own = [head_colors(*pair) for pair in zip(heads, updates_of(heads, 3, random), strict=True)]
    torch.testing.assert_close(torch.cat(own).detach(), guess.colors, atol=2e-6, rtol=0)


@pytest.mark.parametrize(("outputs", "rank"), [(VERTEX_OUTPUTS, 2), (FACE_OUTPUTS | TRUST, 2), (FACE_OUTPUTS, None)])
def test_updates_are_those_of_the_layers_weights(random, outputs, rank):
    head = GaussianHead(12, 10, outputs).requires_grad_(False)
    for parameter in head.parameters():
        parameter.normal_(std=0.5, generator=random)
    features, colors = torch.randn(20, 12, generator=random), torch.rand(20, 3, generator=random)
    seen = torch.randn(20, 3, generator=random) if "trust" in outputs else None
    rows = torch.tensor([4, 4, 17, 0, 9])
    cache = cache_head(head, features, colors, seen, rows)
    updates = zero_updates(cache, rank, random)
    names = [name for name, size in outputs.items() for _ in range(size)]
    kept = torch.tensor([name in ("colors", "trust") for name in names])
    with torch.no_grad():
        for _, up in updates:
            up.normal_(generator=random)
        first, second, last = (up.T @ down for down, up in updates)
    head.first.weight += first
    head.second.weight += second
    head.last.weight[kept] += last
    raw = {name: part[0] for name, part in head(features[None]).items()}
    wanted = decode_colors(raw, colors, seen)[rows]
    torch.testing.assert_close(head_colors(cache, updates).detach(), wanted, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("texture", "most"), [("lora", 0.9), ("full", 0.996)])  # of a small network
def test_without_a_step_the_heads_give_the_calibrated_guess_and_with_steps_explain_the_photo(case, hand, texture, most):
    crop, guess, heads = case
    dark = torch.linspace(0.5, 1, len(crop.image))[:, None, None]  # a gradient that no calibration explains
    crop = crop._replace(image=crop.image * dark)
    start, end = (
        adapt(hand, [guess], [crop], replace(LORA, texture=texture, texture_steps=steps), heads=heads)
        for steps in (0, 30)
    )
    torch.testing.assert_close(start.gaussians.colors, start.calibration.apply(guess.colors), atol=4e-6, rtol=0)
    assert all(torch.equal(a, b) for a, b in zip(end.gaussians[:-2], guess[:-2], strict=True))
    assert sum(end.losses[-5:]) < most * sum(end.losses[:5])


def test_the_same_seed_gives_the_same_updates(case, hand):
    crop, guess, heads = case
    first, again, other = (
        adapt(hand, [guess], [crop], replace(LORA, seed=seed), heads=heads).gaussians.colors for seed in (1, 1, 2)
    )
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_in_every_step_all_reference_views_hold_the_guess_better_than_one_by_colour_alone(case, hand):
    crop, guess, heads = case
    few = replace(LORA, texture_steps=6, reference_views=1, weight_ssim=0.0)
    turns, every = (
        adapt(hand, [guess], [crop], replace(few, references=how), heads=heads) for how in ("in_turn", "all")
    )
    assert turns.losses == pytest.approx(every.losses, rel=1e-6)  # of a single view, by colour alone, they are the same
    far = replace(few, texture_steps=12, reference_views=2, weight_ssim=1.0, weight_reference=100.0, references="all")
    held = adapt(hand, [guess], [crop], far, heads=heads)
    free = adapt(hand, [guess], [crop], replace(far, reference_views=0), heads=heads)
    calibrated = held.calibration.apply(guess.colors)
    moved = [float((made.gaussians.colors - calibrated).abs().mean()) for made in (held, free)]
    assert moved[0] < 0.5 * moved[1]


def test_the_photo_and_all_reference_views_are_held_against_their_pictures_by_lpips_too(case, hand):
    crop, guess, heads = case
    every, seen = replace(LORA, references="all", texture_steps=3), []

    def difference(images, targets, masks):
        seen.append((images.shape, masks.shape))
        return ((images - targets).square() * masks[..., None]).mean((1, 2, 3))

    plain = adapt(hand, [guess], [crop], every, heads=heads)
    with_it = adapt(hand, [guess], [crop], every, heads=heads, perceptual=difference)
    size = len(crop.image)
    assert seen == 3 * 3 * [((1, size, size, 3), (1, size, size))]
    # At first references are as they were, so that the photo's distance is what its loss gains.
    assert with_it.losses[0] > plain.losses[0]
    doubled = adapt(hand, [guess], [crop], replace(every, weight_perceptual=10.0), heads=heads, perceptual=difference)
    assert doubled.losses[0] - plain.losses[0] == pytest.approx(2 * (with_it.losses[0] - plain.losses[0]), rel=1e-3)


def test_what_has_no_heads_is_refused(case, hand):
    crop, guess, _ = case
    with pytest.raises(InputError, match="'none': has no heads"):
        prior_guess(MeanPrior(hand), crop, LORA)
    with pytest.raises(ValueError, match="expected the heads of the prior, got none"):
        adapt(hand, [guess], [crop], LORA)
    with pytest.raises(ValueError, match="is for one photo"):
        adapt(hand, [guess] * 2, [crop] * 2, LORA)


def test_updates_start_at_nothing_and_as_wide_as_their_layers_inputs_ask(random):
    head, rows = GaussianHead(12, 40, VERTEX_OUTPUTS), torch.arange(9)
    cache = cache_head(head, torch.rand(9, 12, generator=random), torch.rand(9, 3, generator=random), None, rows)
    for inputs, outputs, (down, up) in zip((12, 40, 40), (40, 40, 3), zero_updates(cache, 64, random), strict=True):
        assert down.shape == (64, inputs) and up.shape == (64, outputs)
        assert not up.any()
        bound = inputs**-0.5
        assert 0.95 * bound < down.abs().max() <= bound
        assert float(down.detach().std()) == pytest.approx(bound / 3**0.5, rel=0.1)
