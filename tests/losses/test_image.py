import math

import pytest
import torch

from oasis_warp.losses.image import masked_dssim, masked_l1, masked_psnr, masked_statistics, ssim_map


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
