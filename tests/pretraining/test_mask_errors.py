"""Masks are wrong as the estimator's are: at the wrist, between fingers, along the rim; and nowhere else."""

import pytest
import torch

from oasis_warp.pretraining.estimator_errors import MASK_NUMBERS, cut_at_wrist, perturb_outline

SIZE = 256
FOCAL = 400.0


def upright_landmarks(count):
    """Wrist below, knuckles above, 0.4 m from the camera."""
    points = torch.zeros(count, 21, 3)
    points[:, :, 2] = 0.4
    points[:, 1:, 1] = -0.09
    points[:, :, 1] += 0.06
    return points


def camera(count):
    return torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]).expand(count, 3, 3)


@pytest.fixture
def comb():
    """A palm with four fingers, 6 pixels between them, and an arm below."""
    mask = torch.zeros(1, SIZE, SIZE)
    mask[:, 110:200, 60:160] = 1
    for k in range(4):
        mask[:, 30:110, 60 + 26 * k : 80 + 26 * k] = 1
    alpha = mask.clone()
    alpha[:, 200:, 70:150] = 1
    return mask, alpha


def numbers(count, seed=0):
    return torch.randn(count, MASK_NUMBERS, generator=torch.Generator().manual_seed(seed))


def test_masks_end_on_the_arm_or_before_it_at_a_straight_line(comb):
    mask, alpha = (plane.expand(3, -1, -1) for plane in comb)
    made = cut_at_wrist(mask, alpha, upright_landmarks(3), camera(3), torch.tensor([-2.0, 0.0, 1.0]))
    ends = [int(torch.nonzero(plane.sum(1) > 10).max()) + 1 for plane in made]
    wrist = SIZE / 2 + 0.06 * FOCAL / 0.4
    metre = FOCAL / 0.4
    wanted = [wrist + metre * (0.007 + 0.0065 * z) for z in (-2, 0, 1)]
    assert ends == pytest.approx(wanted, abs=1.01)
    above = slice(0, int(min(wanted)) - 1)
    assert torch.equal(made[:, above], alpha[:, above])


def test_no_strength_no_error(comb):
    mask, alpha = comb
    assert torch.equal(cut_at_wrist(mask, alpha, upright_landmarks(1), camera(1), torch.ones(1), 0.0), mask)
    assert torch.equal(perturb_outline(mask, numbers(1), 0.0), mask)


def test_rims_wander_by_some_pixels_and_no_farther(comb):
    mask = comb[0].expand(32, -1, -1)
    made = perturb_outline(mask, numbers(32))
    for strength in (1.0, 2.0):
        shares = perturb_outline(mask, numbers(32), strength)
        assert float(shares.min()) >= 0 and float(shares.max()) <= 1
    wrong = (made - mask).abs() > 0.5
    assert not wrong[:, 115:195, 65:155].any(), "the middle of the palm"
    assert not wrong[:, :24].any() and not wrong[:, 206:].any() and not wrong[:, :, :54].any(), "the background"
    share = wrong.float().sum((1, 2)) / mask.sum((1, 2))
    assert 0.002 < float(share.median()) < 0.1


def test_some_gaps_between_fingers_are_filled_in(comb):
    mask = comb[0].expand(64, -1, -1)
    gap = perturb_outline(mask, numbers(64))[:, 40:105, 81:85].mean((1, 2))
    assert float((gap > 0.5).float().mean()) > 0.1, "filled in"
    assert float((gap < 0.1).float().mean()) > 0.2, "left open"


def test_masks_depend_on_their_own_numbers_alone(comb):
    mask = comb[0].expand(4, -1, -1)
    drawn = numbers(4)
    together = perturb_outline(mask, drawn)
    for k in range(4):
        assert torch.equal(perturb_outline(mask[k : k + 1], drawn[k : k + 1])[0], together[k])
    assert not torch.equal(together[0], together[1])
