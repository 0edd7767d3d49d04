import torch

from oasis_warp.losses.image import detail_difference


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
