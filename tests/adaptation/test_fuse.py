"""Several photos of one hand whose colours are known."""

import pytest
import torch
from synthetic import BACK_TO_CAMERA, PALM_TO_CAMERA, crop_of

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.adaptation.fuse import fuse
from oasis_warp.adaptation.reliability import look, photo_gains
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.mixture import mix_guesses
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.losses.image import masked_psnr
from oasis_warp.render.render import render

STEPS = AdaptConfig(texture_steps=30, calibration_steps=20)
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
    return fuse(hand, crops, [1.0] * len(crops), [MeanPrior(hand)(one) for one in crops], config)


@pytest.fixture(scope="module")
def fused(hand, palm, back):
    return fused_by_mean(hand, [palm, lit(back, LIGHT)], STEPS)


@pytest.fixture(scope="module")
def alone(hand, palm):
    return adapt(hand, MeanPrior(hand)(palm), palm, STEPS)


def likeness(hand, gaussians, crop, light):
    normals = surface.vertex_normals(crop.rest.vertices, hand.faces)
    posed = pose_gaussians(gaussians, hand.faces, crop.rest.vertices, crop.posed.vertices, (light, normals))
    image = render(posed, crop.camera).image
    return masked_psnr(image, crop.image, (crop.mask > 0.9).float())


def test_two_photos_explain_palm_and_back_in_the_light_of_the_first(hand, palm, back, fused, alone):
    assert likeness(hand, fused.gaussians, palm, fused.lights[0]) > 27
    of_back = likeness(hand, fused.gaussians, back, fused.lights[1])  # but for the gain, and so is `back`
    assert of_back > 24
    assert of_back > likeness(hand, alone.gaussians, back, alone.light) + 1.5


def test_the_light_of_photos_that_share_a_side_is_told_exactly(hand, colors, palm):
    other = lit(crop_of(hand, colors, pose_name="victory")[0], LIGHT)
    sightings = look(hand, [palm, other], [1.0, 1.0])
    found = photo_gains(sightings, torch.full_like(colors, 0.5))  # a guess that knows nothing
    assert torch.allclose(found[0], torch.ones(3))
    assert torch.allclose(found[1], LIGHT, atol=0.06)


def test_the_light_of_palm_and_back_is_told_by_the_guess(fused):
    found = fused.gains[1]
    assert torch.allclose(found / found.mean(), LIGHT / LIGHT.mean(), atol=0.05)
    assert float((found / LIGHT).log().abs().max()) < 0.15  # how much lighter palms are is a guess


def test_a_shadow_over_part_of_a_photo_is_no_change_of_its_light(hand, palm):
    shaded = palm.image.clone()
    shaded[: len(shaded) // 3] *= 0.5  # the finger tips
    found = photo_gains(look(hand, [palm, palm._replace(image=shaded)], [1.0, 1.0]), torch.full((12337, 3), 0.5))
    assert float(found[1].min()) > 0.93


def test_of_one_photo_comes_what_one_shot_adaptation_makes_of_it(hand, palm):
    few = AdaptConfig(texture_steps=3, calibration_steps=3)
    alone = adapt(hand, MeanPrior(hand)(palm), palm, few).gaussians
    assert torch.equal(fused_by_mean(hand, [palm], few).gaussians.colors, alone.colors)


def test_the_same_photo_twice_is_nearly_one_photo(hand, palm, alone):
    twice = fused_by_mean(hand, [palm, palm], STEPS)
    assert torch.allclose(twice.gains, torch.ones(2, 3))
    assert float((twice.gaussians.colors - alone.gaussians.colors).abs().mean()) < 0.01
    assert twice.lights is not None
    of_both = likeness(hand, twice.gaussians, palm, twice.lights[0])
    assert abs(of_both - likeness(hand, alone.gaussians, palm, alone.light)) < 0.5


def test_a_place_belongs_to_the_photo_that_shows_it_larger(hand, palm, back):
    sightings = look(hand, [palm, palm, back], [1.0, 0.5, 1.0])  # the second is an enlargement
    shown = (sightings.confidence[0] > 0.5) & (sightings.confidence[2] == 0)
    assert torch.all(sightings.share[0, shown] == 1)
    assert torch.allclose(sightings.share[1, shown], torch.tensor(0.25**2))
    assert torch.all(sightings.share[2, shown] < 0.01)


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
    made = fuse(hand, [photo, other], [1.0, 0.5], guesses, quick)
    shown = made.sightings.confidence.amin(0) > 0
    torch.testing.assert_close(made.sightings.share[:, shown].mean(1), torch.tensor([1.0, 0.5**4]), atol=1e-3, rtol=0)


def test_guesses_in_different_light_mix_to_one_in_the_light_of_the_first(hand, palm):
    guess = MeanPrior(hand)(palm)
    tinted = guess._replace(colors=(guess.colors * LIGHT).clamp(0, 1))
    made = mix_guesses([guess, tinted], torch.ones(2, len(hand.template)), hand.faces)
    same = mix_guesses([guess, guess], torch.ones(2, len(hand.template)), hand.faces)
    torch.testing.assert_close(made.colors, same.colors, atol=0.01, rtol=0)
