"""Haze, wounds and the colour of the back: known answers."""

import pytest
import torch

from oasis_warp.core.color import cielab, linear_light, luminance
from oasis_warp.evaluation.blemishes import HAZE_REACH, darkest_over_median, haze, mean_light, redness


def test_colours_have_their_known_coordinates():
    colors = torch.tensor([[1.0, 1, 1], [1, 0, 0], [0, 0, 1], [0.5, 0.5, 0.5]])
    known = torch.tensor([[100.0, 0, 0], [53.24, 80.09, 67.20], [32.30, 79.19, -107.86], [53.39, 0, 0]])
    torch.testing.assert_close(cielab(colors), known, atol=0.05, rtol=0)
    torch.testing.assert_close(luminance(colors)[:2], torch.tensor([1.0, 0.2126]))
    assert float(linear_light(torch.tensor([0.02, 0.5, 1]))[0]) == pytest.approx(0.02 / 12.92)


def test_haze_is_the_alpha_beyond_its_reach_over_the_silhouette():
    silhouette = torch.zeros(64, 64, dtype=torch.bool)
    silhouette[20:40, 20:40] = True
    alpha = silhouette.float()
    alpha[20, 40 : 40 + HAZE_REACH] = 1  # a soft outline is none
    nowhere = torch.zeros_like(silhouette)
    assert haze(alpha, silhouette, nowhere) == 0
    alpha[20, 40 + HAZE_REACH : 50] = 0.5
    assert haze(alpha, silhouette, nowhere) == pytest.approx(0.5 * (10 - HAZE_REACH) / 400)
    assert haze(alpha, silhouette, alpha == 0.5) == 0


def test_a_gash_of_two_percent_of_the_palm_is_a_wound_and_a_speck_is_none():
    where = torch.ones(40, 40, dtype=torch.bool)
    image = torch.full((40, 40, 3), 0.7)
    image[0, :10] = 0.1
    assert darkest_over_median(image, where) == pytest.approx(1)
    image[0] = 0.1
    found = darkest_over_median(image, where)
    assert found is not None and found < 0.2
    assert darkest_over_median(image, where & (image[..., 0] < 0.5)) is None


def test_a_red_palm_and_a_dim_back():
    where = torch.ones(40, 40, dtype=torch.bool)
    red, grey = torch.tensor([0.8, 0.6, 0.5]).expand(40, 40, 3), torch.full((40, 40, 3), 0.6)
    of_red, of_grey = redness(red, where), redness(grey, where)
    assert of_red is not None and of_grey is not None and of_red > 10 and abs(of_grey) < 0.1
    light, dim = mean_light(grey, where), mean_light(grey * torch.tensor([0.5, 1, 1]), where)
    assert light is not None and dim is not None
    assert float((dim / light)[0]) < 0.3 and float(dim[2]) == pytest.approx(float(light[2]))
    assert mean_light(grey, where & False) is None
