import math

import pytest
import torch

from oasis_warp.losses.image import detail_difference, masked_dssim, masked_l1, masked_psnr, masked_statistics, ssim_map


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(24, 20, 3, generator=generator, dtype=torch.float64)
    return image, (image + 0.1 * torch.randn(24, 20, 3, generator=generator, dtype=torch.float64)).clamp(0, 1)


def left_half(image):
    mask = torch.zeros(image.shape[:2], dtype=image.dtype)
    mask[:, : image.shape[1] // 2] = 1
    return mask


def test_losses_of_equal_images_are_zero(pair):
    image, _ = pair
    mask = torch.ones(image.shape[:2], dtype=image.dtype)
    assert float(masked_l1(image, image, mask)) == 0
    assert abs(float(masked_dssim(image, image, mask))) < 1e-12


def test_what_is_outside_the_mask_does_not_count(pair):
    image, other = pair
    mask = left_half(image)
    changed = other.clone()
    changed[:, image.shape[1] // 2 :] = 0.3
    assert torch.equal(masked_l1(image, other, mask), masked_l1(image, changed, mask))
    assert masked_psnr(image, other, mask) == masked_psnr(image, changed, mask)


def test_psnr_of_a_known_error():
    image = torch.full((4, 5, 3), 0.5)
    assert math.isclose(masked_psnr(image, image + 0.1, torch.ones(4, 5)), 20.0, abs_tol=1e-5)


def test_statistics_inside_a_mask_are_those_of_its_pixels(pair):
    image, _ = pair
    mask = left_half(image)
    pixels = image[:, : image.shape[1] // 2].reshape(-1, 3)
    mean, std = masked_statistics(image, mask, epsilon=0.0)
    torch.testing.assert_close(mean, pixels.mean(0))
    torch.testing.assert_close(std, pixels.std(0, correction=0))


def test_ssim_agrees_with_a_direct_sum_at_an_inner_pixel(pair):
    image, other = pair
    x = torch.arange(11, dtype=torch.float64) - 5
    window = torch.exp(-(x**2) / (2 * 1.5**2))
    weight = (window[:, None] * window / window.sum() ** 2)[..., None]
    a, b = image[5:16, 4:15], other[5:16, 4:15]  # around row 10, column 9
    ma, mb = (weight * a).sum((0, 1)), (weight * b).sum((0, 1))
    va, vb = (weight * a * a).sum((0, 1)) - ma**2, (weight * b * b).sum((0, 1)) - mb**2
    cov = (weight * a * b).sum((0, 1)) - ma * mb
    direct = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    torch.testing.assert_close(ssim_map(image, other)[10, 9], direct.mean(), atol=1e-12, rtol=0)


def test_losses_have_the_right_gradients(pair):
    image, other = (x[:12, :12].clone() for x in pair)
    mask = left_half(image)
    image.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: masked_dssim(x, other, mask), (image,))
    assert torch.autograd.gradcheck(lambda x: masked_l1(x, other, mask), (image,))


def test_an_empty_mask_gives_finite_losses(pair):
    image, other = pair
    nothing = torch.zeros(image.shape[:2], dtype=image.dtype)
    assert float(masked_l1(image, other, nothing)) == 0
    assert math.isfinite(masked_psnr(image, other, nothing))


def pictures(seed=0):
    random = torch.Generator().manual_seed(seed)
    return torch.rand(2, 16, 16, 3, generator=random), torch.ones(2, 16, 16)


def test_equal_pictures_cost_nothing_and_a_plain_shift_next_to_nothing():
    image, mask = pictures()
    assert not detail_difference(image, image, mask).any()
    assert float(detail_difference(image, image + 0.1, mask).max()) < 1e-6


def test_lost_detail_costs_more_than_its_mean_colour_says():
    image, mask = pictures()
    flat = image.mean((1, 2), keepdim=True).expand_as(image)
    shifted = image + (flat - image).abs().mean()
    assert bool((detail_difference(flat, image, mask) > 100 * detail_difference(shifted, image, mask)).all())


def test_what_lies_outside_the_mask_does_not_count():
    image, mask = pictures()
    mask[:, 8:] = 0
    other = image.clone()
    other[:, 8:] = 0
    assert torch.equal(detail_difference(image, 0.5 * image, mask), detail_difference(other, 0.5 * other, mask))


def test_a_coarse_difference_is_felt_at_coarse_scales():
    mask = torch.ones(1, 32, 32)
    flat = torch.full((1, 32, 32, 3), 0.5)
    ramp = flat + 0.01 * torch.arange(32)[:, None, None]
    # slope .01 a pixel at full, .02 at half, .04 at quarter resolution; one of two directions, a third of 6 sums
    assert abs(float(detail_difference(ramp, flat, mask)) - 0.035 / 1) < 0.004
