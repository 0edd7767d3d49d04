"""Each measure of a picture against a case worked out by hand; contrast of skin by size of detail."""

import math

import numpy as np
import pytest
import torch

from oasis_warp.core.bands import SIGMAS, split_bands
from oasis_warp.evaluation.band_energy import BANDS, KEPT, SIZE, contrasts, log_brightness
from oasis_warp.evaluation.kernel_distance import (
    LAYERS,
    Sample,
    hand_features,
    kernel_distance,
    kernel_distances,
)
from oasis_warp.evaluation.metrics import ERROR_FLOOR, MEASURES, MIN_PIXELS, TargetTruth, match_colors, score
from oasis_warp.losses import SSIM_C1

SIDE, LOW, HIGH = 64, 16, 48
"""Of the picture, and where the hand, a square, begins and ends."""
INNER = slice(LOW + 2, HIGH - 2)


def square(value=0.5, hidden=None, stretched=None, squeezed=None):
    mask = torch.zeros(SIDE, SIDE)
    mask[LOW:HIGH, LOW:HIGH] = 1
    nowhere = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    return TargetTruth(
        value * mask[..., None].expand(-1, -1, 3), mask, torch.ones_like(mask),
        *(nowhere if part is None else part for part in (hidden, stretched, squeezed)), mask > 0.5,
    )  # fmt: skip


def halves():
    """Left half true, right half false."""
    return (torch.arange(SIDE) < SIDE // 2).expand(SIDE, SIDE)


def test_the_same_picture_has_no_error():
    truth = square()
    found = score(truth.image, truth)
    assert tuple(found) == MEASURES
    assert found["psnr"] == found["psnr_inner"] == pytest.approx(-10 * torch.tensor(ERROR_FLOOR).log10().item())
    assert found["ssim"] == found["ssim_box"] == found["ssim_mask"] == pytest.approx(1)
    assert found["lpips"] is None


def test_an_error_of_a_tenth_is_20_db():
    truth = square()
    found = score(truth.image + 0.1, truth)
    assert found["psnr"] == pytest.approx(20, abs=1e-4)
    assert found["psnr_inner"] == pytest.approx(20, abs=1e-4)


def test_hidden_skin_is_compared_in_contrast_and_likeness():
    """A mean has less contrast and more likeness than another sample, which has all contrast and none of the rest."""
    random = torch.Generator().manual_seed(0)
    everywhere = torch.ones(256, 256, dtype=torch.bool)
    detail, other = torch.randn(2, 256, 256, 1, generator=random)

    def picture(part):
        return (0.5 * (0.1 * part).exp()).expand(-1, -1, 3)

    truth = TargetTruth(picture(detail), everywhere.float(), everywhere.float(), *[everywhere] * 4)
    half, sample = score(picture(0.5 * detail), truth), score(picture(other), truth)
    for band in BANDS:
        assert half[f"hidden contrast {band}"] == pytest.approx(0.5, rel=0.02)
        assert half[f"hidden likeness {band}"] == pytest.approx(1.0, abs=0.01)
        assert sample[f"hidden contrast {band}"] == pytest.approx(1.0, abs=0.25)
        assert abs(sample[f"hidden likeness {band}"]) < 0.2
    assert score(picture(detail), truth._replace(hidden=~everywhere))["hidden contrast <1"] is None


def test_errors_at_the_outline_do_not_count_inside():
    truth = square()
    image = truth.image.clone()
    image[INNER, INNER] += 0.01
    image[LOW : LOW + 2] = 0
    found = score(image, truth)
    assert found["psnr_inner"] == pytest.approx(40, abs=1e-3)
    assert found["psnr"] is not None and found["psnr"] < 20


def test_parts_are_told_apart():
    truth = square(hidden=halves(), stretched=halves().T, squeezed=~halves().T)
    image = truth.image.clone()
    image[halves()] += 0.1
    image[~halves()] += 0.01
    found = score(image, truth)
    assert found["psnr_hidden"] == pytest.approx(20, abs=1e-3)
    assert found["psnr_visible"] == pytest.approx(40, abs=1e-2)
    both = pytest.approx(-10 * torch.tensor((0.1**2 + 0.01**2) / 2).log10().item(), abs=1e-3)
    assert found["psnr_stretched"] == both and found["psnr_squeezed"] == both
    assert found["psnr_unchanged"] is None


def test_of_a_part_of_few_pixels_nothing_is_said():
    few = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    few[30, 20 : 20 + MIN_PIXELS // 2] = True
    found = score(square().image, square(hidden=few))
    assert found["psnr_hidden"] is None
    assert found["psnr_visible"] is not None and found["psnr_stretched"] is None


def test_what_is_not_known_is_not_judged():
    truth = square()
    known = torch.ones(SIDE, SIDE)
    known[:, 32:] = 0
    share = known[..., None]
    truth = truth._replace(image=truth.image * share, mask=truth.mask * known, known=known)
    image = truth.image.clone()
    image[:, 32:] = 0.9
    assert score(image, truth)["ssim"] == pytest.approx(1)


def test_ssim_is_the_formula_in_the_mask_and_rises_with_the_black_round_it():
    a, b = 0.5, 0.7
    truth = square(a)
    image = truth.image * (b / a)
    inside = TargetTruth(truth.image, torch.zeros(SIDE, SIDE), *truth[2:])
    inside.mask[26:38, 26:38] = 1  # further from the edge than the window reaches: no structure, luminance alone
    expected = (2 * a * b + SSIM_C1) / (a * a + b * b + SSIM_C1)
    assert score(image, inside)["ssim_mask"] == pytest.approx(expected, abs=1e-4)
    assert score(image, inside)["ssim_box"] == pytest.approx(expected, abs=1e-4)
    found = score(image, truth)
    assert found["ssim_box"] == pytest.approx(found["ssim_mask"])
    assert found["ssim"] > found["ssim_mask"] + 0.01  # type: ignore[operator]


def test_lpips_is_asked_about_the_hand_where_it_is_there():
    truth = square()
    asked = []

    def distance(images, targets, masks):
        asked.append((images.shape, targets.shape, masks.shape))
        return (images - targets).abs().mean((1, 2, 3))

    found = score(truth.image + 0.2 * truth.mask[..., None], truth, distance)
    assert found["lpips"] == pytest.approx(0.2 * (HIGH - LOW) ** 2 / SIDE**2)
    assert asked == [((1, SIDE, SIDE, 3), (1, SIDE, SIDE, 3), (1, SIDE, SIDE))]


def test_a_picture_without_a_hand_has_no_numbers_but_ssim():
    nothing = square()._replace(image=torch.zeros(SIDE, SIDE, 3), mask=torch.zeros(SIDE, SIDE))
    found = score(torch.zeros(SIDE, SIDE, 3), nothing)
    assert found["psnr"] is None and found["ssim_box"] is None
    assert found["ssim"] == pytest.approx(1)


def test_coloured_light_is_matched_channel_by_channel():
    truth = square()
    light = torch.tensor([1.3, 0.9, 0.5])
    matched = match_colors(truth.image * light, truth.image, truth.mask)
    torch.testing.assert_close(matched, truth.image)
    assert float(match_colors(torch.zeros_like(truth.image), truth.image, truth.mask).abs().max()) == 0


AMPLITUDE = 0.05


def grating(wavelength, size=SIZE):
    """A wave of the logarithm of the luminance, as sRGB."""
    x = torch.arange(size, dtype=torch.float64) + 0.5
    wave = AMPLITUDE * torch.sin(2 * math.pi * x / wavelength).expand(size, size)
    linear = 0.3 * wave.exp()
    return (1.055 * linear ** (1 / 2.4) - 0.055)[..., None].expand(-1, -1, 3).float()


def disc(radius=100):
    y, x = torch.meshgrid(*[torch.arange(SIZE) - SIZE / 2 + 0.5] * 2, indexing="ij")
    return (x.square() + y.square()).sqrt() < radius


def of(image, weight, where):
    found = contrasts([(split_bands(log_brightness(image), weight.float()), where)])
    assert found is not None
    return found


def expected(wavelength, band):
    """A Gaussian passes exp(-(w s)^2 / 2) of a wave; of a sine the smallest `KEPT` of its values count."""
    w = 2 * math.pi / wavelength
    passed = [1.0, *(math.exp(-((w * sigma) ** 2) / 2) for sigma in SIGMAS)]
    end = KEPT * math.pi / 2
    kept = (end / 2 - math.sin(2 * end) / 4) / end
    return 100 * AMPLITUDE * (passed[band] - passed[band + 1]) * math.sqrt(kept)


@pytest.mark.parametrize(("wavelength", "band"), [(3.3, 0), (9.1, 1), (18.3, 2), (37.0, 3)])
def test_a_grating_lands_in_its_band_with_its_contrast(wavelength, band):
    found = of(grating(wavelength), torch.ones(SIZE, SIZE), disc(90))
    assert found[band] == max(found)
    # 3 %: the grating is sampled at few phases, and the largest values are cut at one of them.
    assert found == pytest.approx([expected(wavelength, k) for k in range(len(BANDS))], rel=0.03, abs=0.02)


def test_the_outline_adds_nothing():
    inside = disc()
    image = torch.where(inside[..., None], 0.6, 0.0) * torch.tensor([1.0, 0.8, 0.7])
    assert max(of(image, inside, inside)) < 1e-2
    everywhere = torch.ones(SIZE, SIZE)
    assert max(of(image, everywhere, inside)) > 1  # without weights it does


def test_what_lies_beside_the_skin_changes_nothing():
    inside, seeded = disc(), torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    image = grating(9.1)
    other = torch.where(inside[..., None], image, seeded)
    assert of(other, inside, inside) == pytest.approx(of(image, inside, inside), rel=1e-4)


def test_a_gain_of_the_light_changes_no_contrast():
    image = grating(18.3)
    linear = ((image + 0.055) / 1.055) ** 2.4
    darker = 1.055 * (0.5 * linear) ** (1 / 2.4) - 0.055
    everywhere = torch.ones(SIZE, SIZE)
    assert of(darker, everywhere, disc()) == pytest.approx(of(image, everywhere, disc()), rel=1e-3)


def test_several_pictures_count_by_their_pixels_and_too_few_pixels_not_at_all():
    everywhere = torch.ones(SIZE, SIZE)
    pictures = torch.full((SIZE, SIZE, 3), 0.5), grating(9.1)
    flat, wave = (split_bands(log_brightness(image), everywhere) for image in pictures)
    both, alone = contrasts([(flat, disc()), (wave, disc())]), contrasts([(wave, disc())])
    assert both is not None and alone is not None
    assert 0.5 * alone[1] < both[1] < 0.8 * alone[1]  # about 1 / sqrt(2), with other values cut
    assert contrasts([(wave, disc(10))]) is None


def crowd(n, shift=0.0, groups=40, within=0.1, seed=0):
    """Pictures of `groups` hands: hands differ by 1, pictures of one by `within`."""
    random = np.random.default_rng(seed)
    hands = random.normal(size=(groups, 8)) + shift
    index = np.arange(n) % groups
    return hands[index] + within * random.normal(size=(n, 8)), [f"{seed} {k}" for k in index]


def test_the_distance_of_two_halves_is_zero_within_its_error_and_its_error_is_that_of_repetitions():
    found = []
    for seed in range(30):
        (x, a), (y, b) = crowd(80, seed=2 * seed), crowd(80, seed=2 * seed + 1)
        found.append(kernel_distance(x, y, a, b))
    values = np.array([each.value for each in found])
    assert abs(values.mean()) < 3 * values.std() / np.sqrt(len(values))
    # Pictures of one hand counted as if independent would give a mean far above 0.
    assert 0.5 < np.median([each.error for each in found]) / values.std() < 2


def test_the_distance_grows_with_the_shift():
    x, a = crowd(80, seed=0)
    near, far = (kernel_distance(x, *(made := crowd(80, shift, seed=1))[:1], a, made[1]).value for shift in (0.5, 1.0))
    assert 0 < near < far


def test_the_distance_is_the_formula_of_the_paper():
    random = np.random.default_rng(0)
    x, y = random.normal(size=(5, 3)), random.normal(size=(6, 3)) + 1
    kernel = lambda a, b: (a @ b / 3 + 1) ** 3  # noqa: E731
    xx = np.mean([kernel(x[i], x[j]) for i in range(5) for j in range(5) if i != j])
    yy = np.mean([kernel(y[i], y[j]) for i in range(6) for j in range(6) if i != j])
    xy = np.mean([kernel(a, b) for a in x for b in y])
    found = kernel_distance(x, y, [f"x{i}" for i in range(5)], [f"y{i}" for i in range(6)])
    assert found.value == pytest.approx(xx + yy - 2 * xy)


def samples(shift, names):
    random = np.random.default_rng(len(names))
    values = [{layer: (random.normal(size=4) * 100 + shift).tolist() for layer in LAYERS} for _ in names]
    return [Sample(name, "palm", features) for name, features in zip(names, values, strict=True)]


def test_layers_are_scaled_and_too_few_hands_are_refused():
    real, drawn = samples(0, [f"r{k}" for k in range(20)]), samples(150, [f"d{k}" for k in range(10)])
    found = kernel_distances(drawn, real, real)
    assert set(found) == {*LAYERS, "all"} and all(0.1 < each.value < 1000 for each in found.values())
    assert found == kernel_distances(drawn, real, real)
    with pytest.raises(ValueError, match="drawn: expected pictures of 4 hands or more, got 2"):
        kernel_distances(drawn[:2], real, real)


def test_features_read_the_hand_and_not_what_lies_beside_it():
    generator = torch.Generator().manual_seed(0)
    image, mask = torch.rand(64, 64, 3, generator=generator), torch.zeros(64, 64)
    mask[16:48, 16:48] = 1
    found = hand_features(image, mask)
    assert [len(found[layer]) for layer in LAYERS] == [48, 80, 160, 256]
    brighter = hand_features((image + 0.2 * mask[..., None]).clamp(0, 1), mask)
    assert not np.allclose(found["half"], brighter["half"], atol=0.01)
    assert found == hand_features(image, mask)
