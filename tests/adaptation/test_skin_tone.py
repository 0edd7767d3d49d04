"""The tone of a person's skin from a guess and a photo."""

import pytest
import torch
from synthetic import crop_of, posed_hand

from oasis_warp.adaptation.skin_tone import infer_tone, tone_colors, with_likely_tone
from oasis_warp.avatar.anchors import place_anchors, vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, skin_regions
from oasis_warp.core.surface import vertex_normals


@pytest.mark.parametrize("melanin", [0.012, 0.05, 0.2])
def test_a_palm_tells_the_back_of_the_same_person(hand, melanin):
    """The back of a dark hand must not come out as light as its palm, nor that of a light one brown."""
    regions = label_regions(hand)
    true, _ = tone_colors(regions, melanin)
    cast = torch.tensor([0.9, 0.85, 0.8])
    tone = infer_tone(hand, true, true * cast, regions.palm)
    back = regions.palm < 0.05
    error = (tone.log_skin - (true * cast).log())[back].mean(0)
    assert float(error.abs().max()) < 0.07  # the posterior mean leans towards the middle: half a tone of the table
    assert tone.melanin == pytest.approx(melanin, rel=0.35)


@pytest.mark.parametrize("melanin", [0.008, 0.03, 0.12])
def test_palms_are_redder_than_backs_and_hardly_darker(hand, melanin):
    regions = label_regions(hand)
    colors, _ = tone_colors(regions, melanin)
    palm, back = ((colors * w[:, None]).sum(0) / w.sum() for w in (regions.palm, 1 - regions.palm))
    assert float(palm[0] / palm[1]) > float(back[0] / back[1]) or melanin > 0.1
    assert float(palm.mean()) > 0.92 * float(back.mean())


SHADING = (0.3, -0.2, 0.25)
"""Gradient of the logarithm of a lamp's shading along the normal."""


def photo_of(hand, melanin, pose_name="fist"):
    """A hand of this tone in the light of a lamp."""
    rest, _, posed = posed_hand(hand, pose_name)
    shade = (vertex_normals(posed.vertices, hand.faces) @ torch.tensor(SHADING)).exp()
    skin, _ = tone_colors(skin_regions(hand), melanin)
    crop, _, _ = crop_of(hand, 0.7 * skin * shade[:, None], 128, pose_name=pose_name)
    return crop, place_anchors(hand, rest)


def guessed(hand, anchors, melanin):
    """A guess of this tone: colours of skin and nails."""
    skin, nail = tone_colors(skin_regions(hand), melanin)
    colors = torch.lerp(skin, nail, skin_regions(hand).nail[:, None])
    return anchors.with_colors(vertex_to_gaussians(colors, hand.faces, anchors))


def melanin_of(hand, guess):
    colors = vertex_colors(guess, len(hand.template))
    return infer_tone(hand, colors, colors, skin_regions(hand).palm).melanin


def reading_of(hand, melanin):
    """What the dense network reads where it sees a hand of this tone."""
    albedo, _ = tone_colors(skin_regions(hand), melanin)
    return torch.cat([hand.template, torch.full_like(albedo[:, :1], 0.002), albedo], 1)[: 111**2].view(111, 111, 7)


@pytest.mark.parametrize(("melanin", "least", "most"), [(0.2, 0.045, 0.25), (0.02, 0.015, 0.035)])
def test_a_palm_brighter_than_the_back_tells_dark_skin_from_dim_light(hand, melanin, least, most):
    """A dark hand whose networks disagreed came out light: its palms and nails were as dark as its back."""
    crop, anchors = photo_of(hand, melanin)
    read = crop._replace(reading=reading_of(hand, 0.08))
    (found,) = with_likely_tone(hand, [guessed(hand, anchors, 0.03)], [read])
    assert least < melanin_of(hand, found) < most


def test_a_photo_of_one_side_leaves_the_tone_to_the_network(hand):
    """Shading alone would make a dark hand of every palm that is bright in its middle."""
    crop, anchors = photo_of(hand, 0.02, "open")
    (found,) = with_likely_tone(hand, [guessed(hand, anchors, 0.1)], [crop])
    assert melanin_of(hand, found) == pytest.approx(0.1, rel=0.35)


def test_a_reading_keeps_dim_light_from_becoming_dark_skin(hand):
    """Two of 52 photos of light hands in dim light had backs as brown as the guess said."""
    crop, anchors = photo_of(hand, 0.02, "open")
    reading = reading_of(hand, 0.02)
    dark = guessed(hand, anchors, 0.25)
    (found,) = with_likely_tone(hand, [dark], [crop._replace(reading=reading)])
    assert 0.01 < melanin_of(hand, found) < 0.1
    unsure = reading.clone()
    unsure[..., 3] = torch.inf
    (alone,) = with_likely_tone(hand, [dark], [crop._replace(reading=unsure)])
    assert melanin_of(hand, alone) > 0.15


def test_photos_of_one_hand_agree_on_its_tone(hand):
    """Each guess had its own tone, and their mean was none of them."""
    crop, anchors = photo_of(hand, 0.02, "open")
    guesses = [guessed(hand, anchors, melanin) for melanin in (0.015, 0.02, 0.2)]
    found = [melanin_of(hand, guess) for guess in with_likely_tone(hand, guesses, [crop] * 3)]
    assert max(found) < 1.1 * min(found) and max(found) < 0.04
