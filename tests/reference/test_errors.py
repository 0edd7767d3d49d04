import math

import torch

from oasis_warp.reference.errors import largest_error, psnr, relative_error, same_bits


def test_relative_error_is_norm_over_norm_where_judged():
    exact = torch.tensor([3.0, 4.0, 100.0])
    got = torch.tensor([3.0, 4.5, 0.0])
    judged = torch.tensor([True, True, False])
    assert relative_error(got, exact, judged) == 0.1
    assert largest_error(got, exact) == 100


def test_relative_error_of_nothing():
    zero = torch.zeros(2)
    assert relative_error(zero, zero) == 0
    assert relative_error(zero + 1, zero) == math.inf


def test_psnr_of_a_tenth_is_twenty_decibels():
    image = torch.zeros(4, 4, 3, dtype=torch.float64)
    assert math.isclose(psnr(image + 0.1, image), 20)
    assert psnr(image, image) == math.inf


def test_bits_tell_what_equality_does_not():
    one = torch.tensor([1.0, 0.0])
    assert same_bits([one], [one.clone()])
    assert not same_bits([one], [torch.tensor([1.0, -0.0])])
    assert not same_bits([one], [one.double()])
    assert not same_bits([one], [torch.nextafter(one, torch.tensor(2.0))])
    assert not same_bits([one], [])
    nan = torch.tensor([math.nan])
    assert same_bits([nan], [nan])
