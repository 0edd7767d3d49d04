import pytest
import torch

from oasis_warp.avatar.appearance import (
    BLOOD,
    MELANIN,
    REGION_NAMES,
    label_regions,
    region_colors,
    region_masks,
    skin_color,
)


def luminance(colors):
    return colors @ torch.tensor([0.2126, 0.7152, 0.0722])


@pytest.fixture(scope="module")
def regions(hand):
    return label_regions(hand)


def test_the_table_is_met_at_its_knots():
    colors = skin_color(torch.tensor([MELANIN[3]]), torch.tensor([BLOOD[1]]))
    torch.testing.assert_close(colors[0] * 255, torch.tensor([177.0, 141.0, 115.0]), atol=1e-3, rtol=0)


def test_more_melanin_is_darker_and_more_blood_is_redder():
    melanin = torch.logspace(-2.3, -0.46, 30)
    light = luminance(skin_color(melanin, torch.full_like(melanin, 0.0125)))
    assert bool((light[1:] < light[:-1]).all())
    pale, red = (skin_color(torch.tensor([0.02]), torch.tensor([b]))[0] for b in (0.006, 0.035))
    assert float(red[0] / red[1]) > float(pale[0] / pale[1])


def test_shares_beyond_the_table_are_clamped():
    inside = skin_color(torch.tensor([0.35]), torch.tensor([0.04]))
    torch.testing.assert_close(skin_color(torch.tensor([5.0]), torch.tensor([1.0])), inside)


def test_palm_and_back_lie_on_opposite_sides(hand, regions):
    palm = hand.template[regions.palm > 0.95, 1].mean()
    back = hand.template[regions.palm < 0.05, 1].mean()
    assert float(palm) < float(back)  # the palm faces -y


def test_five_nails_lie_on_the_back_near_the_tips(hand, regions):
    nails = regions.nail > 0.5
    assert sorted(hand.segment[nails].unique().tolist()) == [3, 6, 9, 12, 15]
    assert float(regions.palm[nails].max()) < 0.1


def test_regions_lie_between_zero_and_one(regions):
    for field in regions[:-1]:
        assert float(field.min()) >= 0
        assert float(field.max()) <= 1


@pytest.mark.parametrize("melanin", [0.006, 0.04, 0.15, 0.35])
def test_palms_are_no_darker_than_backs_and_much_lighter_in_dark_skin(regions, melanin):
    light = luminance(region_colors(regions, melanin))
    palm, back = float(light[regions.palm > 0.95].mean()), float(light[regions.palm < 0.05].mean())
    assert palm > back - 0.01
    if melanin > 0.1:
        assert palm > back + 0.08


def test_region_masks_split_the_surface(regions):
    masks = region_masks(regions)
    assert tuple(masks) == REGION_NAMES
    torch.testing.assert_close(sum(masks.values()), torch.ones_like(regions.palm))


def test_skin_is_mottled_the_same_way_every_time(hand, regions):
    label_regions.cache_clear()
    assert torch.equal(label_regions(hand).mottle, regions.mottle)
    assert abs(float(regions.mottle.mean())) < 0.05
    colors = region_colors(regions, 0.04)
    back = (regions.palm < 0.05) & (regions.nail < 0.1) & (regions.knuckle < 0.1)
    assert 0.005 < float(colors[back].std(0).mean()) < 0.04


def test_labels_are_the_same_on_any_device(hand, regions, device):
    found = label_regions(hand.to(device))
    for name, want in regions._asdict().items():
        torch.testing.assert_close(getattr(found, name).cpu(), want, rtol=0, atol=1e-5, msg=name)
