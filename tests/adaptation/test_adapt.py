import pytest
import torch
from synthetic import BACK_TO_CAMERA, PALM_TO_CAMERA, crop_of

from oasis_warp.adaptation.adapt import adapt, detail_of
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import inner_mask, observe
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanPrior, estimate_melanin
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.types import CanonicalGaussians, HandCrop
from oasis_warp.losses.image import masked_psnr
from oasis_warp.render.render import render

CAST = torch.tensor([0.90, 0.85, 0.80])  # a little dim and warm
STEPS = AdaptConfig(texture_steps=60)


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
    return crop, truth, prior, adapt(hand, prior, crop, STEPS)


def drawn(hand, gaussians, crop, light=None):
    shining = None if light is None else (light, surface.vertex_normals(crop.rest.vertices, hand.faces))
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
        completed = adapt(hand, prior._replace(colors=colors), crop, untaught)
        image = drawn(hand, completed.gaussians, crop, completed.light).image
        assert masked_psnr(image, crop.image, inside) > 28


def test_the_side_that_was_not_seen_takes_the_light_of_the_photo(hand, regions, case):
    _, truth, _, adapted = case
    back = (regions.palm < 0.05) & (regions.nail < 0.1) & (hand.template[:, 0] < -0.02)
    on_back = back[adapted.gaussians.vertex_index]
    true, fitted = (g.colors[: len(on_back)][on_back].mean(0) for g in (truth, adapted.gaussians))
    assert float((fitted - true).norm()) < 0.15  # a palm alone leaves brown skin and warm light alike


def test_detail_is_read_off_a_photo_only_where_it_surely_shows_the_skin(hand, case):
    crop, _, _, adapted = case
    assert detail_of(hand, adapted.gaussians, crop, None) is crop
    plain = detail_of(hand, adapted.gaussians, crop, adapted.light)
    outside = crop.mask < 0.01
    background = torch.tensor([0.1, 0.9, 0.2])
    rim = (crop.mask > 0.9) & (inner_mask(crop.mask, 2) < 0.5)
    stained = torch.where((outside | rim)[..., None], background, crop.image)
    found = detail_of(hand, adapted.gaussians, crop._replace(image=stained), adapted.light)
    inside = inner_mask(crop.mask, 12) > 0.9
    assert int(rim.sum()) > 100 and int(inside.sum()) > 100
    assert float(found.mask[rim].mean()) < 0.3 < 0.7 < float(plain.mask[rim].mean())
    torch.testing.assert_close(found.mask[inside], plain.mask[inside])
    torch.testing.assert_close(found.image[inside], plain.image[inside])


def test_there_is_no_seam_where_seen_meets_unseen(hand, case):
    crop, _, _, _ = case
    plain, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5) * torch.tensor([1.1, 0.9, 0.8]))
    adapted = adapt(hand, MeanPrior(hand)(plain), plain, STEPS).gaussians
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
    first, second = (adapt(hand, prior, crop, few).gaussians.colors for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.gpu
def test_a_gpu_finds_what_the_cpu_finds(hand, case):
    crop, _, _, adapted = case

    def there(nouns):
        return type(nouns)(*(part.cuda() if isinstance(part, torch.Tensor) else part for part in nouns))

    moved = HandCrop(*(part.cuda() if isinstance(part, torch.Tensor) else there(part) for part in crop))
    found = adapt(hand, MeanPrior(hand)(moved), moved, STEPS).gaussians
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
    assert len(adapt(hand, prior, crop, AdaptConfig(texture_steps=3)).losses) == 3
    assert len(adapt(hand, prior, crop, AdaptConfig(texture_steps=0)).losses) == 0


def test_without_calibration_what_was_not_seen_stays_as_the_prior_has_it(hand, regions, case):
    crop, _, prior, _ = case
    back = ((regions.palm < 0.05) & (regions.nail < 0.1))[prior.vertex_index]  # the photo shows the palm
    moved = {}
    for choice in ("on", "off"):
        config = AdaptConfig(calibration=choice, texture_steps=0, reference_views=0)
        adapted = adapt(hand, prior, crop, config)
        change = (adapted.gaussians.colors - prior.colors)[: len(back)][back]
        moved[choice] = float(change.abs().amax(1).median())
    assert adapted.calibration.gain.tolist() == [1, 1, 1] and adapted.calibration.offset.tolist() == [0, 0, 0]
    assert moved["off"] < 0.03 < 0.05 < moved["on"]  # the rest is what fades over from the palm


@pytest.mark.parametrize("orientation", [PALM_TO_CAMERA, BACK_TO_CAMERA])
@pytest.mark.parametrize("melanin", [0.01, 0.05, 0.25])
def test_skin_tones_are_told_apart(hand, regions, orientation, melanin):
    crop, _, _ = crop_of(hand, region_colors(regions, melanin), orientation=orientation)
    estimate = estimate_melanin(regions, observe(hand, crop))
    assert 0.4 < estimate / melanin < 2.5
