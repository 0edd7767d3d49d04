"""Creases cross the palm's side of the wrist; veins and tendons go along the arm."""

import math

import numpy as np
import pytest

from oasis_warp.avatar.arm_lines import CREASES, arm_lines

ALONG = np.linspace(-0.01, 0.03, 401)


def lines_at(angle, seed=0):
    return arm_lines(0.028, np.full(len(ALONG), angle), ALONG, seed).mean(1)


@pytest.mark.parametrize("seed", range(5))
def test_each_crease_is_a_narrow_dark_line_on_the_palms_side_only(seed):
    """A wrist without them was a tube."""
    inner, outer = lines_at(0.0, seed), lines_at(math.pi, seed)
    for place, strength in CREASES:
        near = np.abs(ALONG - place) < 0.0045  # its path sways
        assert inner[near].min() < -0.06 * strength, (place, inner[near].min())
        assert np.median(inner[near]) > inner[near].min() / 2
    assert outer[ALONG < 0].min() > -0.02


def test_a_seed_has_its_own_lines_and_they_close_around_the_arm():
    assert np.array_equal(lines_at(0.1), lines_at(0.1))
    assert np.abs(lines_at(0.1) - lines_at(0.1, 1)).max() > 0.05
    assert np.abs(lines_at(-math.pi) - lines_at(math.pi)).max() < 1e-9
