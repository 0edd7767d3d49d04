import cv2
import numpy as np
import pytest
import torch

from oasis_warp.synthetic.body import bundled_body
from oasis_warp.synthetic.identity import Population, sample_identity
from oasis_warp.synthetic.spectrum import _TO_RGB, ABOVE_MELANIN, Tint, _layers, skin_colors


def skin_reflectance(melanin, blood, *, oxygen=0.7, epidermis=80.0, carotene=0.0):
    """Linear sRGB reflectance of skin, summed over all wavelengths."""
    crossed, dermis = _layers(melanin[:, None], blood[:, None], oxygen, epidermis, carotene)
    return ((ABOVE_MELANIN + (1 - ABOVE_MELANIN) * crossed * dermis) @ _TO_RGB.T).clip(0.002, 0.95)


def linear_to_lab(linear):
    return cv2.cvtColor(np.float32(linear)[None], cv2.COLOR_LRGB2Lab)[0]


def test_the_table_of_a_person_agrees_with_the_spectrum():
    rng = np.random.default_rng(0)
    melanin, blood = np.exp(rng.uniform(np.log(0.004), np.log(0.5), 200)), np.exp(rng.uniform(-5.5, -2.5, 200))
    how = {"oxygen": 0.75, "epidermis": 80.0, "carotene": 0.1}
    other = how | {"oxygen": 0.15}
    tints = [Tint(**how), Tint(**other)]
    first, second = skin_colors(torch.from_numpy(melanin).float(), torch.from_numpy(blood).float(), tints)
    np.testing.assert_allclose(first.T, skin_reflectance(melanin, blood, **how), atol=3e-3)
    np.testing.assert_allclose(second.T, skin_reflectance(melanin, blood, **other), atol=3e-3)


def test_melanin_darkens_and_blood_reddens():
    melanin = np.geomspace(0.005, 0.4, 12)
    lab = linear_to_lab(skin_reflectance(melanin, np.full(12, 0.0125)))
    assert (np.diff(lab[:, 0]) < 0).all()
    pale, flushed = linear_to_lab(skin_reflectance(np.array([0.02, 0.02]), np.array([0.006, 0.04])))
    assert flushed[1] > pale[1] + 5


def test_bare_light_skin_is_where_measured_skin_is():
    lab = linear_to_lab(skin_reflectance(np.array([0.01]), np.array([0.012])))[0]
    assert 64 < lab[0] < 73 and 6 < lab[1] < 13 and 10 < lab[2] < 20


def test_identities_are_a_function_of_seed_and_number():
    hand = bundled_body().hand
    a, b = (sample_identity(hand, 5, 9, Population()) for _ in range(2))
    np.testing.assert_array_equal(a.shape, b.shape)
    assert a[1:] == b[1:]
    assert sample_identity(hand, 5, 10, Population()).melanin != a.melanin
    assert sample_identity(hand, 6, 9, Population()).melanin != a.melanin


@pytest.mark.parametrize("kind", ["freckles", "hair", "polish", "tattoo", "ring", "plaster"])
def test_a_kind_that_the_population_lacks_never_occurs_and_changes_nothing_else(kind):
    hand = bundled_body().hand
    shown = {"freckles": "freckles", "hair": "hairs", "polish": "polish", "tattoo": "tattoo", "ring": "ring_finger",
             "plaster": "plaster"}[kind]  # fmt: skip
    absent = {"ring": -1, "polish": None}.get(kind, 0)
    for number in range(20):
        with_it = sample_identity(hand, 0, number, Population(**{kind: 1.0}))
        without = sample_identity(hand, 0, number, Population(**{kind: 0.0}))
        assert getattr(without, shown) == absent
        same = with_it._replace(**{shown: absent}, shape=None), without._replace(shape=None)
        assert same[0] == same[1]


def test_identities_cover_the_range_of_human_skin():
    hand = bundled_body().hand
    melanin = np.array([sample_identity(hand, 0, n, Population()).melanin for n in range(300)])
    lab = linear_to_lab(skin_reflectance(melanin, np.full(300, 0.0135)))
    assert lab[:, 0].max() > 66 and lab[:, 0].min() < 33
