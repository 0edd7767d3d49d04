"""Contrasts of skin: gratings of known frequency land in their band, and an outline adds nothing."""

import math

import pytest
import torch

from oasis_warp.evaluation.band_energy import BANDS, KEPT, SIGMAS, SIZE, contrasts, log_brightness, split_bands

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
