"""What may be background, or a finger before the palm, does not count as skin."""

import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation import reliability
from oasis_warp.adaptation.reliability import mask_unreliable
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import inner_mask

SKIN, WALL = (0.7, 0.5, 0.4), (0.1, 0.3, 0.8)


@pytest.fixture(scope="module")
def shown(hand):
    """A flat hand in one colour before a blue wall, and what is drawn of it."""
    crop, *_ = crop_of(hand, 0.8 * region_colors(label_regions(hand), 0.03))
    skin, wall = (torch.tensor(color).expand_as(crop.image) for color in (SKIN, WALL))
    share = crop.mask[..., None]
    return crop._replace(image=share * skin + (1 - share) * wall), skin


def test_a_right_mask_is_left_as_it_is(hand, shown):
    crop, drawn = shown
    sure = mask_unreliable(hand, drawn, crop)
    assert float((sure.mask - crop.mask).abs().mean() / crop.mask.mean()) < 0.06
    deep = inner_mask(crop.mask, 8) > 0.5
    assert float(sure.mask[deep].mean()) > 0.97
    assert sure.image is crop.image


def test_background_inside_the_mask_does_not_count(hand, shown):
    crop, drawn = shown
    wider = len(crop.mask) // 64  # 1 px of 96
    fat = crop._replace(mask=-inner_mask(-crop.mask, wider))  # the largest so near
    added = (fat.mask > 0.99) & (crop.mask < 0.01)
    assert int(added.sum()) > 100
    sure = mask_unreliable(hand, drawn, fat)
    assert float(sure.mask[added].mean()) < 0.1  # slits that the mask has closed have no wall in them
    kept = inner_mask(crop.mask, 2) > 0.99
    assert float(sure.mask[kept].mean()) > 0.95


def test_a_spot_of_the_walls_colour_far_from_the_border_is_the_hands(hand, shown):
    crop, drawn = shown
    deep = inner_mask(crop.mask, 10) > 0.5
    painted = crop._replace(image=torch.where(deep[..., None], torch.tensor(WALL), crop.image))
    before, after = (mask_unreliable(hand, drawn, e).mask[deep] for e in (crop, painted))
    assert torch.equal(before, after)


def test_skin_that_looks_like_the_wall_counts(hand, shown):
    crop, drawn = shown
    same = crop._replace(image=drawn)
    assert float(mask_unreliable(hand, drawn, same).mask.mean() / crop.mask.mean()) > 0.95


def test_what_lies_just_behind_a_finger_does_not_count(hand, shown):
    crop, drawn = shown
    side = len(crop.mask)
    bent = crop.posed.vertices.clone()
    finger = (hand.segment == 3) | (hand.segment == 2)  # hangs in the air 5 cm before the palm, over it
    toward = -bent.mean(0) / bent.mean(0).norm()
    down = bent[hand.segment == 0].mean(0) - bent[finger].mean(0)
    bent[finger] += 0.7 * down + 0.05 * toward
    before = crop._replace(posed=crop.posed._replace(vertices=bent), mask=torch.ones(side, side))
    image = drawn.clone()
    lost = mask_unreliable(hand, drawn, before._replace(image=image)).mask < 0.5
    assert 100 < int(lost.sum()) < 0.1 * side * side


def test_the_palm_beside_a_finger_that_lies_on_it_is_unreliable(hand, monkeypatch):
    """Finger tips that touch the palm lie less than `BEHIND_GAP` above it: their picture stayed on the opened palm."""
    shares = {}
    for name in ("fist", "open"):
        crop, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5), pose_name=name, size=128)
        with monkeypatch.context() as patch:
            sure = mask_unreliable(hand, crop.image, crop).mask
            patch.setattr(reliability, "FINGER_GAP", torch.inf)
            shares[name] = float((mask_unreliable(hand, crop.image, crop).mask - sure).sum() / crop.mask.sum())
    assert shares["fist"] > 0.02 and shares["open"] < 0.01
