"""Damaged photos: quality falls gently, the report says so, and nothing is infinite or explodes."""

from pathlib import Path

import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.adaptation.sharpen import sharpen
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.data.photo import read_photo
from oasis_warp.reconstruction import reconstruct
from studies.damage import DAMAGES
from studies.stress import is_sane, likeness, make

pytestmark = pytest.mark.slow

PHOTO = Path(__file__).parent / "data" / "photos" / "palm_open_left_02.png"
FEW = ReconstructConfig(size=256, steps=20)
SAID = {
    "mask eroded": "", "mask dilated": "", "landmarks off": "poor fit", "half out": "border", "warm light": "",
    "cold light": "colour of skin", "dark": "dark photo", "blurred": "blurred photo", "tiny": "small hand",
    "nail polish": "", "tattoo": "", "glove": "colour of skin",
}  # fmt: skip
"""What the report must warn about, if anything."""
LIKE = 18.0
"""An avatar of a damaged photo is as like that of the whole one as this, at least [dB]."""
LIKE_IN_THE_DARK = 17.0
"""The same for a photo with hardly any light, of which less is told apart from skin."""


@pytest.fixture(scope="module")
def crop(hand):
    return crop_of(hand, region_colors(label_regions(hand), 0.03), size=48)[0]


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


def test_gaussians_that_are_no_numbers_no_colours_or_too_large_are_told(hand, crop):
    gaussians = MeanPrior(hand)(crop)
    assert is_sane(gaussians)
    for name, value in (("colors", float("nan")), ("colors", 1.5), ("scales", 1.0), ("opacities", float("inf"))):
        broken = getattr(gaussians, name).clone()
        broken.view(-1)[7] = value
        assert not is_sane(gaussians._replace(**{name: broken})), name


@pytest.fixture(scope="module")
def whole():
    photo = read_photo(PHOTO)
    return photo, reconstruct(photo, FEW)


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_photo_makes_a_hand_and_the_report_says_what_ails_it(whole, name):
    photo, base = whole
    assert base.warnings == ()
    made = make(DAMAGES[name](photo, base), FEW, force=True)
    assert is_sane(made.avatar.gaussians)
    assert likeness(base.avatar, made.avatar) > (LIKE_IN_THE_DARK if name == "dark" else LIKE)
    assert SAID[name] in "; ".join(made.warnings)


def test_two_reconstructions_with_the_same_seed_have_the_same_bits(whole):
    photo, base = whole
    again = reconstruct(photo, FEW).avatar.gaussians
    assert all(map(torch.equal, again, base.avatar.gaussians))
