"""Adapting to photos of a hand whose colours are known, and the optimiser's steps."""

import re
from pathlib import Path

import pytest
import torch
from synthetic import BACK_TO_CAMERA, PALM_TO_CAMERA, crop_of

import oasis_warp.adaptation
from oasis_warp.adaptation.adam import Adam
from oasis_warp.adaptation.adapt import adapt
from oasis_warp.adaptation.prior_guess import mix_guesses
from oasis_warp.adaptation.reliability import observe_photos, photo_gains
from oasis_warp.adaptation.unlit import unlit_detail, view_in_photo
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import inner_mask, observe
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanHands, MeanPrior
from oasis_warp.avatar.vertex_light import with_photo
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.types import CanonicalGaussians, HandCrop
from oasis_warp.losses import masked_psnr
from oasis_warp.render import render

CAST = torch.tensor([0.90, 0.85, 0.80])  # a little dim and warm
STEPS = AdaptConfig(texture_steps=25)


@pytest.fixture(scope="module")
def regions(hand):
    return label_regions(hand)


def stripes(hand):
    """Detail that no prior knows: stripes across the hand, 12 mm apart."""
    return 0.08 * torch.sin(hand.template[:, :1] * (2 * torch.pi / 0.012))


@pytest.fixture(scope="module")
def case(hand, regions):
    colors = (region_colors(regions, 0.03) * CAST + stripes(hand)).clamp(0, 1)
    crop, truth, _ = crop_of(hand, colors)
    prior = MeanPrior(hand)(crop)
    return crop, truth, prior, adapt(hand, [prior], [crop], STEPS)


def drawn(hand, gaussians, crop, light=None):
    shining = None if light is None else with_photo(light, crop.rest.vertices, crop.posed.vertices, hand.faces)
    posed = pose_gaussians(gaussians, hand.faces, crop.rest.vertices, crop.posed.vertices, shining)
    return render(posed, crop.camera)


def test_the_photo_is_explained(hand, case):
    crop, _, prior, adapted = case
    inside = (crop.mask > 0.9).float()
    before = masked_psnr(drawn(hand, prior, crop).image, crop.image, inside)
    after = masked_psnr(drawn(hand, adapted.gaussians, crop, adapted.light).image, crop.image, inside)
    assert after > before + 8
    assert after > 30


def test_what_is_drawn_is_completed_and_not_what_each_gaussian_would_be_alone(hand, case):
    crop, _, prior, _ = case
    n = len(prior.vertex_index)
    apart = torch.cat([prior.colors[:n] + 0.1, prior.colors[n:] - 0.1]).clamp(0, 1)  # they overlap everywhere
    inside = (crop.mask > 0.9).float()
    for colors in (prior.colors, apart):
        untaught = AdaptConfig(texture_steps=0, reference_views=0)
        completed = adapt(hand, [prior._replace(colors=colors)], [crop], untaught)
        image = drawn(hand, completed.gaussians, crop, completed.light).image
        assert masked_psnr(image, crop.image, inside) > 28


def test_the_side_that_was_not_seen_takes_the_light_of_the_photo(hand, regions, case):
    _, truth, _, adapted = case
    back = (regions.palm < 0.05) & (regions.nail < 0.1) & (hand.template[:, 0] < -0.02)
    on_back = back[adapted.gaussians.vertex_index]
    true, fitted = (g.colors[: len(on_back)][on_back].mean(0) for g in (truth, adapted.gaussians))
    assert float((fitted - true).norm()) < 0.15  # a palm alone leaves brown skin and warm light alike


def test_detail_is_trusted_only_where_the_photo_surely_shows_the_skin(hand, case):
    """Background that became colour of the skin at outlines was a stain in every other pose."""
    crop, _, _, adapted = case
    weights = view_in_photo(hand, adapted.gaussians, crop).weights
    whole, trust = unlit_detail(hand, adapted.gaussians, crop, weights, None)
    assert whole is crop and bool((trust == 1).all())
    plain, before = unlit_detail(hand, adapted.gaussians, crop, weights, adapted.light)
    outside = crop.mask < 0.01
    background = torch.tensor([0.1, 0.9, 0.2])
    rim = (crop.mask > 0.9) & (inner_mask(crop.mask, 5) < 0.5)
    stained = torch.where((outside | rim)[..., None], background, crop.image)
    found, after = unlit_detail(hand, adapted.gaussians, crop._replace(image=stained), weights, adapted.light)
    inside = inner_mask(crop.mask, 12) > 0.9
    seen = observe(hand, crop)
    pixels = (seen.uv * len(rim)).long().clamp(0, len(rim) - 1)
    on_rim = rim[pixels[:, 1], pixels[:, 0]] & (seen.confidence > 0.5)
    amid = inside[pixels[:, 1], pixels[:, 0]] & (seen.confidence > 0.5)
    assert int(on_rim.sum()) > 50 and int(amid.sum()) > 100
    assert float(after[on_rim].mean()) < 0.4 < 0.6 < float(before[on_rim].mean())
    torch.testing.assert_close(after[amid], before[amid])
    torch.testing.assert_close(found.image[inside], plain.image[inside])


def test_there_is_no_seam_where_seen_meets_unseen(hand, case):
    crop, _, _, _ = case
    plain, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5) * torch.tensor([1.1, 0.9, 0.8]))
    adapted = adapt(hand, [MeanPrior(hand)(plain)], [plain], STEPS).gaussians
    smooth = region_colors(label_regions(hand), 0.03)
    field = torch.zeros_like(hand.template)
    field[adapted.vertex_index] = adapted.colors[: len(adapted.vertex_index)]
    kept = torch.zeros(len(hand.template), dtype=torch.bool)
    kept[adapted.vertex_index] = True
    edges = torch.cat([hand.faces[:, [0, 1]], hand.faces[:, [1, 2]]])
    edges = edges[kept[edges].all(1)]
    step = (field[edges[:, 0]] - field[edges[:, 1]]).norm(dim=-1)
    usual = (smooth[edges[:, 0]] - smooth[edges[:, 1]]).norm(dim=-1)
    assert float(step.quantile(0.999)) < 2.5 * float(usual.quantile(0.999))
    assert crop.image.shape == plain.image.shape


def test_the_same_seed_gives_the_same_bits(hand, case):
    crop, _, prior, _ = case
    few = AdaptConfig(texture_steps=5)
    first, second = (adapt(hand, [prior], [crop], few).gaussians.colors for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.gpu
def test_a_gpu_finds_what_the_cpu_finds(hand, case):
    crop, _, _, adapted = case

    def there(nouns):
        return nouns and type(nouns)(*(part.cuda() if isinstance(part, torch.Tensor) else part for part in nouns))

    moved = HandCrop(*(part.cuda() if isinstance(part, torch.Tensor) else there(part) for part in crop[:-1]))
    found = adapt(hand, [MeanPrior(hand)(moved)], [moved], STEPS).gaussians
    assert found.colors.is_cuda
    back = CanonicalGaussians(*(part if part is None else part.cpu() for part in found))
    pictures = [drawn(hand, gaussians, crop).image for gaussians in (back, adapted.gaussians)]
    assert masked_psnr(*pictures, torch.ones_like(crop.mask)) > 45


def test_colours_stay_colours(case):
    colors = case[3].gaussians.colors
    assert bool(torch.isfinite(colors).all())
    assert 0 <= float(colors.min()) <= float(colors.max()) <= 1


def test_texture_learning_stops_by_itself_and_obeys_a_given_number(hand, case):
    crop, _, prior, _ = case
    assert len(adapt(hand, [prior], [crop], AdaptConfig(texture_steps=3)).losses) == 3
    assert len(adapt(hand, [prior], [crop], AdaptConfig(texture_steps=0)).losses) == 0


def test_without_calibration_what_was_not_seen_stays_as_guessed(hand, regions, case):
    crop, _, prior, _ = case
    back = ((regions.palm < 0.05) & (regions.nail < 0.1))[prior.vertex_index]  # the photo shows the palm
    moved = {}
    for choice in ("on", "off"):
        config = AdaptConfig(calibration=choice, texture_steps=0, reference_views=0)
        adapted = adapt(hand, [prior], [crop], config)
        change = (adapted.gaussians.colors - adapted.guess.colors)[: len(back)][back]
        moved[choice] = float(change.abs().amax(1).median())
    assert adapted.calibration.gain.tolist() == [1, 1, 1] and adapted.calibration.offset.tolist() == [0, 0, 0]
    assert moved["off"] < 0.03 < 0.05 < moved["on"]  # the rest is what fades over from the palm


@pytest.mark.parametrize("orientation", [PALM_TO_CAMERA, BACK_TO_CAMERA])
@pytest.mark.parametrize("melanin", [0.01, 0.05, 0.25])
def test_skin_tones_are_told_apart(hand, regions, orientation, melanin):
    crop, _, _ = crop_of(hand, region_colors(regions, melanin), orientation=orientation)
    seen = observe(hand, crop)
    estimate = float(MeanHands(hand)(seen.colors[None], seen.confidence[None]).log_melanin.exp())
    assert 0.4 < estimate / melanin < 2.5


FUSED_STEPS = AdaptConfig(texture_steps=30, calibration_steps=20)
LIGHT = torch.tensor([0.75, 0.85, 1.1])
"""Of the photo of the back over that of the palm."""


def lit(crop, gain):
    return crop._replace(image=(crop.image * gain).clamp(0, 1))


@pytest.fixture(scope="module")
def colors(hand):
    stripes = 0.08 * torch.sin(hand.template[:, :1] * (2 * torch.pi / 0.012))
    return (region_colors(label_regions(hand), 0.03) * 0.8 + stripes).clamp(0, 1)


@pytest.fixture(scope="module")
def palm(hand, colors):
    return crop_of(hand, colors, orientation=PALM_TO_CAMERA)[0]


@pytest.fixture(scope="module")
def back(hand, colors):
    return crop_of(hand, colors, orientation=BACK_TO_CAMERA)[0]


def fused_by_mean(hand, crops, config):
    return adapt(hand, [MeanPrior(hand)(one) for one in crops], crops, config)


@pytest.fixture(scope="module")
def fused(hand, palm, back):
    return fused_by_mean(hand, [palm, lit(back, LIGHT)], FUSED_STEPS)


@pytest.fixture(scope="module")
def alone(hand, palm):
    return adapt(hand, [MeanPrior(hand)(palm)], [palm], FUSED_STEPS)


def likeness(hand, gaussians, crop, light):
    there = crop.rest.vertices, crop.posed.vertices
    posed = pose_gaussians(gaussians, hand.faces, *there, with_photo(light, *there, hand.faces))
    image = render(posed, crop.camera).image
    return masked_psnr(image, crop.image, (crop.mask > 0.9).float())


def test_two_photos_explain_palm_and_back_in_the_light_of_the_first(hand, palm, back, fused, alone):
    assert likeness(hand, fused.gaussians, palm, fused.lights[0]) > 27
    of_back = likeness(hand, fused.gaussians, back, fused.lights[1])  # but for the gain, and so is `back`
    assert of_back > 24
    assert of_back > likeness(hand, alone.gaussians, back, alone.light) + 1.5


def test_the_light_of_photos_that_share_a_side_is_told_exactly(hand, colors, palm):
    other = lit(crop_of(hand, colors, pose_name="victory")[0], LIGHT)
    observations = observe_photos(hand, [palm, other], [1.0, 1.0])
    found = photo_gains(observations, torch.full_like(colors, 0.5))  # a guess that knows nothing
    assert torch.allclose(found[0], torch.ones(3))
    assert torch.allclose(found[1], LIGHT, atol=0.06)


def test_the_light_of_palm_and_back_is_told_by_the_guess(fused):
    found = fused.gains[1]
    assert torch.allclose(found / found.mean(), LIGHT / LIGHT.mean(), atol=0.05)
    assert float((found / LIGHT).log().abs().max()) < 0.15  # how much lighter palms are is a guess


def test_a_shadow_over_part_of_a_photo_is_no_change_of_its_light(hand, palm):
    shaded = palm.image.clone()
    shaded[: len(shaded) // 3] *= 0.5  # the finger tips
    seen = observe_photos(hand, [palm, palm._replace(image=shaded)], [1.0, 1.0])
    found = photo_gains(seen, torch.full((12337, 3), 0.5))
    assert float(found[1].min()) > 0.93


def test_the_same_photo_twice_is_nearly_one_photo(hand, palm, alone):
    twice = fused_by_mean(hand, [palm, palm], FUSED_STEPS)
    assert torch.allclose(twice.gains, torch.ones(2, 3))
    assert float((twice.gaussians.colors - alone.gaussians.colors).abs().mean()) < 0.01
    assert twice.lights is not None
    of_both = likeness(hand, twice.gaussians, palm, twice.lights[0])
    assert abs(of_both - likeness(hand, alone.gaussians, palm, alone.light)) < 0.5


def test_a_place_belongs_to_the_photo_that_shows_it_larger(hand, palm, back):
    observations = observe_photos(hand, [palm, palm, back], [1.0, 0.5, 1.0])  # the second is an enlargement
    shown = (observations.confidence[0] > 0.5) & (observations.confidence[2] == 0)
    assert torch.all(observations.share[0, shown] == 1)
    assert torch.allclose(observations.share[1, shown], torch.tensor(0.25**2))
    assert torch.all(observations.share[2, shown] < 0.01)


def test_equal_guesses_mix_to_themselves(hand, palm):
    guess = MeanPrior(hand)(palm)
    weight = torch.rand(2, len(hand.template), generator=torch.Generator().manual_seed(0)) + 0.1
    mixed = mix_guesses([guess, guess._replace(quats=-guess.quats)], weight, hand.faces)
    assert torch.equal(mixed.vertex_index, guess.vertex_index) and torch.equal(mixed.face_index, guess.face_index)
    for name in ("offsets", "barycentrics", "quats", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(mixed, name), getattr(guess, name), msg=name)


def test_a_gaussian_that_one_guess_lacks_is_fainter(hand, palm):
    guess = MeanPrior(hand)(palm)
    n, half = len(guess.vertex_index), torch.arange(0, len(guess.face_index), 2)
    rows = torch.cat([torch.arange(n), n + half])
    fewer = guess._replace(
        face_index=guess.face_index[half], barycentrics=guess.barycentrics[half],
        **{name: getattr(guess, name)[rows] for name in ("quats", "scales", "opacities", "colors")},
    )  # fmt: skip
    mixed = mix_guesses([guess, fewer], torch.ones(2, len(hand.template)), hand.faces)
    assert torch.equal(mixed.face_index, guess.face_index)
    ratio = mixed.opacities[n:] / guess.opacities[n:]
    assert torch.allclose(ratio[0::2], torch.tensor(1.0)) and torch.allclose(ratio[1::2], torch.tensor(0.5))
    torch.testing.assert_close(mixed.scales, guess.scales)


def test_the_photo_that_has_more_pixels_of_a_place_is_believed_there(hand, colors):
    """Two photos in one view that agree on nothing: the one that was enlarged counts for less."""
    photo = crop_of(hand, colors, size=48)[0]
    other = photo._replace(image=photo.image.flip(-1))
    guess = MeanPrior(hand)(photo)
    guesses = [guess, guess._replace(opacities=0.5 * guess.opacities)]
    quick = AdaptConfig(texture_steps=1, calibration_steps=1, reference_views=0)
    made = adapt(hand, guesses, [photo, other], quick, resolutions=[1.0, 0.5])
    shown = made.observations.confidence.amin(0) > 0
    share = made.observations.share[:, shown].mean(1)
    torch.testing.assert_close(share, torch.tensor([1.0, 0.5**4]), atol=1e-3, rtol=0)


def test_guesses_in_different_light_mix_to_one_in_the_light_of_the_first(hand, palm):
    guess = MeanPrior(hand)(palm)
    tinted = guess._replace(colors=(guess.colors * LIGHT).clamp(0, 1))
    made = mix_guesses([guess, tinted], torch.ones(2, len(hand.template)), hand.faces)
    same = mix_guesses([guess, guess], torch.ones(2, len(hand.template)), hand.faces)
    torch.testing.assert_close(made.colors, same.colors, atol=0.01, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_have_the_bits_of_torchs(dtype):
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(shape, generator=generator, dtype=dtype) for shape in ((7, 3), (5,))]
    found, want = ([start.clone().requires_grad_() for start in starts] for _ in range(2))
    ours, theirs = Adam(found, 0.01), torch.optim.Adam(want, lr=0.01)
    for k in range(20):
        losses = [((a * a).sum() * (1 + k) + b.sin().sum() * a[0, 0]) for a, b in (found, want)]
        ours.step(losses[0])
        theirs.zero_grad()
        losses[1].backward()
        theirs.step()
    assert all(torch.equal(a, b) for a, b in zip(found, want, strict=True))


def test_fitting_a_photo_does_not_load_torchs_compiler():
    # Any optimiser of torch imports torch._dynamo, a tenth of a first run.
    for folder in oasis_warp.adaptation.__path__:
        users = [file.name for file in Path(folder).glob("*.py") if re.search(r"= torch\.optim\.", file.read_text())]
        assert not users
