"""The tone of a person's skin from a guess and a photo."""

import pytest
import torch

from oasis_warp.adaptation.skin_tone import MOST_APART, infer_tone, tone_colors
from oasis_warp.avatar.appearance import label_regions


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


def test_a_reading_keeps_dim_light_from_becoming_dark_skin(hand):
    """Two of 52 photos of light hands in dim light had backs as brown as the guess said."""
    regions = label_regions(hand)
    guess, light = (tone_colors(regions, melanin)[0] for melanin in (0.25, 0.02))
    reading = torch.cat([hand.template, torch.full_like(light[:, :1], 0.002), light], 1)[: 111**2].view(111, 111, 7)
    tone = infer_tone(hand, guess, guess, regions.palm, reading)
    assert 0.03 < tone.melanin < 1.4 * 0.02 * torch.tensor(MOST_APART).exp()
    unsure = reading.clone()
    unsure[..., 3] = torch.inf
    alone = infer_tone(hand, guess, guess, regions.palm)
    for other in (infer_tone(hand, guess, guess, regions.palm, unsure), infer_tone(hand, light, light, regions.palm)):
        assert other.melanin == pytest.approx(alone.melanin if other.melanin > 0.1 else 0.02, rel=0.35)
