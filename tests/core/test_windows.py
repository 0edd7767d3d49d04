"""Means and maxima over squares of pixels."""

import torch

from oasis_warp.core.windows import largest_around, mean_around, smooth_mean_around


def direct(planes: torch.Tensor, pixels: int, beyond: float) -> torch.Tensor:
    """All values of each pixel's square, [..., H, W, squares]; `beyond` the picture."""
    padded = torch.nn.functional.pad(planes, [pixels] * 4, value=beyond)
    return padded.unfold(-2, 2 * pixels + 1, 1).unfold(-2, 2 * pixels + 1, 1).flatten(-2)


def test_a_mean_is_that_of_the_whole_square_with_nothing_beyond_the_picture():
    """Rows and columns are turned twice; a picture that is not square shows a wrong turn."""
    planes = torch.rand(3, 9, 14, generator=torch.Generator().manual_seed(1))
    for pixels in (0, 1, 4):
        torch.testing.assert_close(mean_around(planes, pixels), direct(planes, pixels, 0.0).mean(-1))
    torch.testing.assert_close(mean_around(planes[0], 2), mean_around(planes, 2)[0])


def test_a_maximum_is_that_of_the_whole_square_even_where_all_is_negative():
    planes = torch.rand(9, 14, generator=torch.Generator().manual_seed(2)) - 2
    for pixels in (0, 1, 4):
        assert largest_around(planes, pixels).equal(direct(planes, pixels, -torch.inf).amax(-1))


def test_a_weighted_mean_forgets_what_has_no_weight_and_is_0_where_nothing_has():
    values = torch.full((9, 14, 3), 0.7)
    weight = torch.rand(9, 14, generator=torch.Generator().manual_seed(3)) * (torch.arange(14) < 7)
    values[:, 7:] = 100.0
    found = smooth_mean_around(values, weight, 1)
    torch.testing.assert_close(found[:, :9], torch.full((9, 9, 3), 0.7))
    assert not found[:, 9:].any()
