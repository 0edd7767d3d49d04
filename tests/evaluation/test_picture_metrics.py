"""Each measure against a case worked out by hand."""

import pytest
import torch

from oasis_warp.evaluation.metrics import ERROR_FLOOR, FEWEST_PIXELS, MEASURES, TargetTruth, match_colors, score
from oasis_warp.losses.image import SSIM_C1

SIZE, LOW, HIGH = 64, 16, 48
"""Of the picture, and where the hand, a square, begins and ends."""
INNER = slice(LOW + 2, HIGH - 2)


def square(value=0.5, hidden=None, stretched=None, squeezed=None):
    mask = torch.zeros(SIZE, SIZE)
    mask[LOW:HIGH, LOW:HIGH] = 1
    nowhere = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    return TargetTruth(
        value * mask[..., None].expand(-1, -1, 3), mask, torch.ones_like(mask),
        *(nowhere if part is None else part for part in (hidden, stretched, squeezed)),
    )  # fmt: skip


def halves():
    """Left half true, right half false."""
    return (torch.arange(SIZE) < SIZE // 2).expand(SIZE, SIZE)


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
    few = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    few[30, 20 : 20 + FEWEST_PIXELS // 2] = True
    found = score(square().image, square(hidden=few))
    assert found["psnr_hidden"] is None
    assert found["psnr_visible"] is not None and found["psnr_stretched"] is None


def test_what_is_not_known_is_not_judged():
    truth = square()
    known = torch.ones(SIZE, SIZE)
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
    inside = TargetTruth(truth.image, torch.zeros(SIZE, SIZE), *truth[2:])
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
    assert found["lpips"] == pytest.approx(0.2 * (HIGH - LOW) ** 2 / SIZE**2)
    assert asked == [((1, SIZE, SIZE, 3), (1, SIZE, SIZE, 3), (1, SIZE, SIZE))]


def test_a_picture_without_a_hand_has_no_numbers_but_ssim():
    nothing = square()._replace(image=torch.zeros(SIZE, SIZE, 3), mask=torch.zeros(SIZE, SIZE))
    found = score(torch.zeros(SIZE, SIZE, 3), nothing)
    assert found["psnr"] is None and found["ssim_box"] is None
    assert found["ssim"] == pytest.approx(1)


def test_coloured_light_is_matched_channel_by_channel():
    truth = square()
    light = torch.tensor([1.3, 0.9, 0.5])
    matched = match_colors(truth.image * light, truth.image, truth.mask)
    torch.testing.assert_close(matched, truth.image)
    assert float(match_colors(torch.zeros_like(truth.image), truth.image, truth.mask).abs().max()) == 0
