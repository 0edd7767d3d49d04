"""Photos of real hands, from files to an avatar; of damaged ones quality falls gently, and the report says so."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic import crop_of
from torch.nn.functional import avg_pool2d

from oasis_warp import reconstruction
from oasis_warp.adaptation.adapt import adapt, add_detail
from oasis_warp.adaptation.sharpen import sharpen
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.avatar.quality import over_photo
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.config import PAPER_ADAPTATION, AdaptConfig, ReconstructConfig, check_config
from oasis_warp.core.errors import InputError
from oasis_warp.core.mirror import mirror_pose
from oasis_warp.core.processes import using_threads
from oasis_warp.core.types import Landmarks, Photo, Render
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, check_sides, choose_hand
from oasis_warp.estimation.hand_crop import crop_hand, crop_landmarks, initial_offsets
from oasis_warp.fitted_avatar import draw_as_photo, make_avatar
from oasis_warp.hand.skinning import hand21, rest_hand, skin
from oasis_warp.losses import detail_difference, masked_psnr
from oasis_warp.reconstruction import input_errors, reconstruct, reconstruct_same_hand
from studies.stress import DAMAGES, DamagedInput, is_sane, likeness, make

PHOTOS = Path(__file__).parent / "data" / "photos"
WOOD = PHOTOS / "same_hand" / "a1_wood_right"
PALM, BACK = WOOD / "02_flat_closed.jpg", WOOD / "03_flat_closed_back.jpg"
OTHER_SIDE = PHOTOS / "same_hand" / "a7_wood_left" / "03_ring_closed.jpg"
SMALL = ReconstructConfig(size=96, steps=10)


def found(*hands):
    """Photos without a pixel, and a hand in each: "name side score"."""
    photos, landmarks = [], []
    for name, side, score in map(str.split, hands):
        photos.append(Photo(torch.zeros(4, 4, 3, dtype=torch.uint8), None, None, name, 1.0))
        landmarks.append(Landmarks(torch.zeros(21, 2), None, side, float(score), 1.0, "network"))
    return photos, landmarks


def test_photos_of_one_side_are_accepted():
    check_sides(*found("a left 0.9", "b left 0.6"))


@pytest.mark.parametrize(
    ("hands", "named"),
    [
        (("a right 0.9", "b left 0.9", "c right 0.9"), "^b: shows a left hand, the other photos a right one"),
        (("a right 0.9", "b left 0.9", "c left 0.9"), "^a: shows a right hand, the other photos a left one"),
        (("a right 0.9", "b left 0.9"), "^b: shows a left hand"),  # the first decides
        (("a right 0.6", "b left 0.9"), "^a: shows a right hand"),  # unless it is less sure
        (("a left 1", "b right 1", "c right 1", "d left 1", "e left 1"), "^b and c: show a right hand.*--hand left"),
    ],
)
def test_a_photo_of_the_other_side_is_named(hands, named):
    with pytest.raises(InputError, match=named):
        check_sides(*found(*hands))


def test_no_photo_is_an_error_of_the_caller():
    with pytest.raises(ValueError, match="photos: expected at least one"):
        reconstruct_same_hand([])


@pytest.mark.parametrize(("options", "message"), [
    ({"light": "nope"}, "light 'nope': expected 'fit' or 'keep' or 'even'"),
    ({"light": None}, "light None: expected 'fit' or 'keep' or 'even'"),
    ({"refine": "nope"}, "refine 'nope': expected 'on' or 'off'"),
    ({"adapt": "nope"}, "adapt 'nope': expected 'field' or 'lora'"),
    ({"steps": -1}, "steps -1: expected 0 or more"),
    ({"size": 3}, "size 3: expected 64 to 1024 pixels"),
    ({"size": 99999}, "size 99999: expected 64 to 1024 pixels"),
    ({"size": "512"}, "size '512': expected an integer or 'auto'; choose another value."),
    ({"size": 512.5}, "size 512.5: expected an integer or 'auto'"),
    ({"size": None}, "size None: expected an integer or 'auto'"),
    ({"hand": "both"}, "hand 'both': expected an integer or 'left' or 'right' or 'largest'"),
    ({"steps": 2.5}, "steps 2.5: expected an integer; choose"),
    ({"seed": "1"}, "seed '1': expected an integer"),
])  # fmt: skip
def test_options_are_checked_before_any_work_from_python_too(options, message):
    with pytest.raises(InputError, match=message):
        reconstruct("there is no such file.jpg", unchecked(options))


def unchecked(options):
    """Options as without the type checker of these tests."""
    config = ReconstructConfig()
    for name, value in options.items():
        object.__setattr__(config, name, value)
    return config


def test_numbers_of_numpy_are_integers_too():
    check_config(unchecked({"size": np.int64(512), "seed": np.uint8(3), "hand": 1}))
    with pytest.raises(InputError, match="size 3: expected 64 to 1024 pixels"):
        check_config(unchecked({"size": np.int64(3)}))


@pytest.mark.parametrize("make", [reconstruct, lambda photo, config: reconstruct_same_hand([photo], config)])
def test_a_device_that_is_not_there_is_refused_as_on_the_command_line(make, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(InputError, match="^device cuda: torch finds no CUDA device; use device cpu, or see `oasis doc"):
        make("there is no such file.jpg", ReconstructConfig(device="cuda"))


def test_what_is_no_photo_is_refused_in_a_sentence(as_shipped):
    pixels = np.zeros((64, 64, 3), np.uint8)
    with pytest.raises(TypeError, match="^photo: expected a Photo or its file, got ndarray; save the picture and give"):
        reconstruct(pixels)
    with pytest.raises(TypeError, match=r"^photo: expected a Photo or its file, got ndarray"):
        reconstruct_same_hand([PALM, pixels])


@pytest.mark.parametrize("alone", ["x.png", Path("x.png"), Photo(torch.zeros(0, 0, 3).byte(), None, None, "x", 1.0)])
def test_one_photo_is_no_list_of_photos(alone, as_shipped):
    said = rf"^photos: expected a list, got one {type(alone).__name__}; put it in brackets, \[photo\]\.$"
    with pytest.raises(TypeError, match=said):
        reconstruct_same_hand(alone)


def test_lora_is_for_one_photo():
    with pytest.raises(InputError, match="adapt lora: works with one photo, got 2; leave it out"):
        reconstruct_same_hand([read_photo(path) for path in (PALM, BACK)], replace(SMALL, adapt="lora"))


def test_photos_of_two_hands_are_refused_before_the_long_work():
    with pytest.raises(InputError, match="03_ring_closed.jpg: shows a left hand, the other photos a right one"):
        reconstruct_same_hand([read_photo(path) for path in (PALM, OTHER_SIDE)], SMALL)


def test_a_photo_without_a_hand_is_named():
    with pytest.raises(InputError, match="^no_hand_cup_15.jpg: found no hand"):
        reconstruct_same_hand([PALM, str(PHOTOS / "no_hand_cup_15.jpg")], SMALL)


@pytest.fixture(scope="module")
def palm():
    return read_photo(PALM)


@pytest.fixture(scope="module")
def alone():
    with torch.no_grad():  # colours could not be learned there
        return reconstruct(str(PALM), SMALL)


def test_lpips_is_of_the_hand_above_the_wrist(crop):
    asked = []

    def perceptual(*pictures):
        asked.append(pictures)
        return torch.tensor([0.25])

    drawn = Render(torch.full_like(crop.image, 0.5), torch.ones_like(crop.mask))
    assert "input_lpips" not in input_errors(drawn, crop)
    assert input_errors(drawn, crop, perceptual)["input_lpips"] == 0.25
    ((image, target, mask),) = asked
    assert torch.equal(image[0], drawn.image) and torch.equal(target[0], crop.image)
    assert torch.equal(mask[0] > 0, (crop.mask > 0.5) & (crop.above_wrist > 0.5))


@pytest.mark.slow
def test_the_papers_adaptation_trains_the_heads_of_the_guess_as_it_is(palm, monkeypatch):
    asked = []

    def watched(hand, guesses, crops, config, **options):
        asked.append((guesses[0], config, options["heads"], options["perceptual"]))
        return adapt(hand, guesses, crops, replace(config, calibration_steps=1, reference_views=1), **options)

    monkeypatch.setattr(reconstruction, "adapt", watched)
    small = replace(SMALL, adapt="lora", light="keep", unseen="plain", steps=2)
    made = reconstruct(palm, small, perceptual=detail_difference)
    ((guess, config, heads, perceptual),) = asked
    assert perceptual is detail_difference and made.errors["input_lpips"] > 0
    assert config == replace(PAPER_ADAPTATION, texture_steps=2)
    # A small photo's Gaussians are made fewer elsewhere, but these have heads of their own, a row for each.
    assert sum(len(head.inputs) for head in heads) == len(guess.colors)
    assert made.errors["input_psnr_db"] > 15


@pytest.mark.slow
def test_even_light_is_asked_for_of_several_photos_as_of_one(palm, monkeypatch):
    asked = []

    def stop(hand, guesses, crops, config, **options):
        asked.append(config.light)
        raise InterruptedError

    monkeypatch.setattr(reconstruction, "adapt", stop)
    for light in ("keep", "even"):
        with pytest.raises(InterruptedError):
            reconstruct_same_hand([palm], replace(SMALL, light=light, prior="none", refine="off"))
    assert asked == ["keep", "even"]


@pytest.mark.slow
def test_one_photo_of_several_gives_the_bits_of_one_with_any_number_of_threads(palm, alone):
    with using_threads(torch.get_num_threads() + 2):
        again = reconstruct_same_hand([palm], SMALL)
        assert torch.get_num_threads() > 2
    for one, other in zip(alone.avatar.gaussians, again.avatar.gaussians, strict=True):
        assert one is other is None or torch.equal(one, other)
    assert torch.equal(alone.avatar.surface_offsets, again.avatar.surface_offsets)
    assert torch.equal(alone.fit.mask, again.photos[0].fit.mask)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_palm_and_back_show_twice_as_much_as_the_palm_and_the_avatar_has_the_detail_of_both(palm, alone, monkeypatch):
    photos, seen = [palm, read_photo(BACK)], []

    def watched(hand, adaptation, *rest):
        seen.extend([adaptation, add_detail(hand, adaptation, *rest)])
        return seen[1]

    monkeypatch.setattr(reconstruction, "add_detail", watched)
    made = reconstruct_same_hand(photos, ReconstructConfig(size=448, steps=10))
    first, second = (photo.errors for photo in made.photos)
    assert made.errors["seen_percent"] > 1.7 * first["seen_percent"]
    assert made.errors["back_seen_percent"] > 50 and made.errors["palm_seen_percent"] > 50
    assert first["best_percent"] > 11 and second["best_percent"] > 11  # of what each surely shows, without scraps
    assert made.photos[0].gain == (1.0, 1.0, 1.0)
    assert first["input_psnr_db"] > 22 and second["input_psnr_db"] > 22
    assert torch.equal(made.photos[0].fit.shape, made.photos[1].fit.shape)
    assert abs(first["mask_iou"] - alone.errors["mask_iou"]) < 0.05
    coarse, fine = seen
    assert len(fine.gaussians.opacities) > len(coarse.gaussians.opacities) + 10_000
    for k, (photo, own) in enumerate(zip(photos, made.photos, strict=True)):
        crop = crop_hand(photo, own.fit, made.avatar.surface_offsets, ReconstructConfig(), 448)
        lit = [(step.gaussians, step.lights[k]) for step in seen] + [(made.avatar.gaussians, own.light)]
        avatars = (make_avatar(own.fit, made.avatar.surface_offsets, crop, *each) for each in lit)
        before, after, finished = (detail_error(shown(avatar, own, crop), crop) for avatar in avatars)
        assert after < 0.9 * before and finished < 0.75 * before, (k, before, after, finished)


def shown(avatar, photo, crop):
    """The avatar over a photo."""
    return over_photo(draw_as_photo(avatar, crop, photo.fit.pose), crop)


def detail_error(picture, crop):
    """Root mean square of what differs from the photo within a few pixels, light aside, away from the outline."""
    inside = inner_mask(crop.mask * crop.above_wrist, 12) > 0.5
    exposure = crop.image[inside].mean(0) / picture[inside].mean(0)  # dark skin has little contrast, right or wrong
    apart = (picture * exposure - crop.image).permute(2, 0, 1)
    fine = apart - avg_pool2d(apart, 9, stride=1, padding=4)
    return float(fine[:, inside].square().mean().sqrt())


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_photo_in_much_less_light_is_brought_to_the_first_one_s_and_both_are_nearly_one(palm, alone):
    dark = palm._replace(rgb=(palm.rgb.float() * 0.4).to(torch.uint8), name="dark.jpg")
    made = reconstruct_same_hand([palm, dark], SMALL)
    assert made.photos[1].gain == pytest.approx((0.4, 0.4, 0.4), abs=0.04)
    assert any(re.match(r"dark.jpg: its light is another, 2\.[3-7] times darker", warning) for warning in made.warnings)
    mean = [avatar.gaussians.colors.mean(0) for avatar in (alone.avatar, made.avatar)]
    assert torch.allclose(*mean, atol=0.04)
    camera = orbit_camera(alone.avatar.mesh(alone.avatar.source_pose).vertices, 0.5, size=96)
    one, two = (each.avatar.render(camera, alone.avatar.source_pose) for each in (alone, made))
    assert masked_psnr(one.image, two.image, (one.alpha > 0.9).float()) > 22  # but for shading, which is evened out


PHOTO = Path(__file__).parent / "data" / "photos" / "thumb_up_left_06.jpg"


def test_landmarks_of_a_left_hand_lie_on_the_mirrored_model(hand):
    photo, estimator = read_photo(PHOTO), HandEstimator(hand)
    fit = estimator.fit(photo, choose_hand(estimator.find(photo), "left", photo.name))
    crop = crop_hand(photo, fit, initial_offsets(hand, fit), ReconstructConfig())
    model = hand21(skin(hand, rest_hand(hand, fit.shape), mirror_pose(fit.pose)), hand)
    away = crop_landmarks(fit, crop.camera) - project(crop.camera, model)[0]
    assert away.norm(dim=1).median() < 8  # px of 256; the mirror image would be a hundred away


@pytest.mark.slow
def test_refinement_of_a_left_hand_moves_it_and_keeps_it_on_its_photo(hand):
    made = {
        switch: reconstruct(PHOTO, replace(SMALL, refine=switch, prior="none", steps=0, light="keep", unseen="plain"))
        for switch in ("on", "off")
    }
    on, off = made["on"], made["off"]
    assert on.prior["name"] == off.prior["name"] == "none"
    assert off.errors["refined_px"] == 0
    assert 0 < on.errors["refined_px"] < 20
    assert not torch.equal(on.fit.pose.angles, off.fit.pose.angles)
    assert on.errors["reprojection_percent"] < 1.3 * off.errors["reprojection_percent"]
    assert on.errors["render_mask_iou"] > off.errors["render_mask_iou"] - 0.02


OPEN_PALM = Path(__file__).parent / "data" / "photos" / "palm_open_left_02.png"
FEW = ReconstructConfig(size=128, steps=5)
DAMAGED = [
    ("tattoo", "mask eroded"), ("nail polish", "mask dilated"), ("warm light", "landmarks off"), ("half out",),
    ("cold light", "blurred"), ("dark",), ("tiny",), ("glove",),
]  # fmt: skip
"""What is done to a photo: those that leave each other's traces at once, which is worse than each alone."""
SAID = {
    "landmarks off": "poor fit", "half out": "border", "cold light": "colour of skin", "dark": "dark photo",
    "blurred": "blurred photo", "tiny": "small hand", "glove": "colour of skin",
}  # fmt: skip
"""What the report must warn about."""
LIKE = 18.0
"""An avatar of a damaged photo is as like that of the whole one as this, at least [dB]."""
LIKE_IN_THE_DARK = 17.0
"""The same for a photo with hardly any light, of which less is told apart from skin."""


@pytest.fixture(scope="module")
def crop(hand):
    return crop_of(hand, region_colors(label_regions(hand), 0.03), size=48)[0]


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["black", "white", "no mask", "all mask", "one pixel", "noise"])
def test_no_photo_and_no_mask_makes_colours_that_are_none(hand, crop, damage):
    image, mask = crop.image, crop.mask
    one = torch.zeros_like(mask)
    one[len(mask) // 2, len(mask) // 2] = 1
    image, mask = {
        "black": (torch.zeros_like(image), mask),
        "white": (torch.ones_like(image), mask),
        "no mask": (image, torch.zeros_like(mask)),
        "all mask": (image, torch.ones_like(mask)),
        "one pixel": (image, one),
        "noise": (torch.rand(image.shape, generator=torch.Generator().manual_seed(0)), mask),
    }[damage]
    damaged = crop._replace(image=image, mask=mask)
    few = AdaptConfig(calibration_steps=5, texture_steps=3, reference_views=1)
    adapted = adapt(hand, [MeanPrior(hand)(damaged)], [damaged], few)
    assert is_sane(sharpen(hand, adapted.gaussians, [damaged]).gaussians)


@pytest.mark.slow
def test_gaussians_that_are_no_numbers_no_colours_or_too_large_are_told(hand, crop):
    gaussians = MeanPrior(hand)(crop)
    assert is_sane(gaussians)
    for name, value in (("colors", float("nan")), ("colors", 1.5), ("scales", 1.0), ("opacities", float("inf"))):
        broken = getattr(gaussians, name).clone()
        broken.view(-1)[7] = value
        assert not is_sane(gaussians._replace(**{name: broken})), name


@pytest.fixture(scope="module")
def whole():
    photo = read_photo(OPEN_PALM)
    return photo, reconstruct(photo, FEW)


def test_every_damage_is_done():
    assert sorted(name for names in DAMAGED for name in names) == sorted(DAMAGES)


@pytest.mark.slow
@pytest.mark.parametrize("names", DAMAGED, ids=" and ".join)
def test_a_damaged_photo_makes_a_hand_and_the_report_says_what_ails_it(whole, names):
    photo, base = whole
    assert base.warnings == ()
    damaged = DamagedInput(photo)
    for name in names:
        damaged = DAMAGES[name](damaged.photo, base)
    made = make(damaged, FEW, force=True)
    assert is_sane(made.avatar.gaussians)
    assert likeness(base.avatar, made.avatar) > (LIKE_IN_THE_DARK if "dark" in names else LIKE)
    said = "; ".join(made.warnings)
    assert all(SAID.get(name, "") in said for name in names)
