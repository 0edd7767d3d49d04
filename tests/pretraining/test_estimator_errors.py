"""The estimator's errors in training: perturbed hands and masks."""

import math

import pytest
import torch

from oasis_warp.hand.poses import named_pose
from oasis_warp.pretraining.estimator_errors import (
    ALIKE,
    MASK_NUMBERS,
    MeasuredErrors,
    bundled_errors,
    cut_at_wrist,
    landmark_shares,
    looks,
    perturb_outline,
    picture_frames,
    simulate_estimate,
    surface_fields,
)
from oasis_warp.pretraining.hand_batch import pose_hands

K = torch.tensor([[500.0, 0, 190], [0, 500, 200], [0, 0, 1]])


def about_axis(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def people(hand, names=("open", "fist", "pinch"), turn=0.0):
    """Hands before a camera, fingers up, then turned in the picture's plane."""
    up = about_axis(turn) @ torch.tensor([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    count = len(names)
    generator = torch.Generator().manual_seed(3)
    return {
        "shape": 0.5 * torch.randn(count, len(hand.shape_names), generator=generator),
        "angles": torch.stack([named_pose(hand, name) for name in names]),
        "orientation": up.expand(count, 3, 3),
        "K": K.expand(count, 3, 3),
        "translation": torch.tensor([[0.01, 0.03, 0.5]]).repeat(count, 1) @ about_axis(turn).T,
    }


def seen(hand, given, measured, choice):
    parts = [given[key] for key in ("shape", "angles", "orientation")]
    true = pose_hands(hand, *parts, given["translation"])
    return true, simulate_estimate(hand, true, *parts, given["K"], measured, choice)


def project(points, K):
    q = points @ K.transpose(-1, -2)
    return q[..., :2] / q[..., 2:]


@pytest.fixture(scope="module")
def errors():
    return bundled_errors(torch.device("cpu"))


def test_without_errors_hands_are_where_they_are(hand, errors):
    given = people(hand)
    true, found = seen(hand, given, errors.scaled(0.0), torch.tensor([0, 1, 2]))
    torch.testing.assert_close(found.posed, true.posed, atol=2e-6, rtol=0)
    torch.testing.assert_close(found.K, given["K"])


def test_vertices_follow_landmarks_by_shares_that_sum_to_one(hand, errors):
    shares = landmark_shares(hand)
    assert torch.equal(shares, errors.shares) and bool((shares >= 0).all())
    torch.testing.assert_close(shares.sum(1), torch.ones(len(shares)))
    thumb, little = (shares[:, rows].sum(1) for rows in (slice(2, 5), slice(18, 21)))
    tips = torch.cat([hand.joints, hand.tips])[hand.keypoint_index][[4, 20]]
    nearest = torch.cdist(tips, hand.template).argmin(1)
    assert float(thumb[nearest[0]]) > 0.95 and float(little[nearest[1]]) > 0.95


def one_error(errors, hand, given):
    """A table whose rows are all the same error; any choice lends it."""
    row = int(errors.place.norm(dim=-1).mean(1).argsort()[len(errors.place) // 2])
    same = {name: getattr(errors, name)[row].expand(ALIKE, *getattr(errors, name).shape[1:])
            for name in ("looks", "angles", "turn", "shape", "lens", "place")}  # fmt: skip
    return errors._replace(**same)


def test_landmarks_are_off_in_the_picture_as_those_of_the_measured_hand(hand, errors):
    given = people(hand)
    table = one_error(errors, hand, given)
    true, found = seen(hand, given, table, torch.zeros(3, dtype=torch.long))
    metre = true.landmarks[..., 2].mean(1) / K[0, 0]
    wanted = (picture_frames(true.landmarks).landmarks @ table.place[:3, :, :, None])[..., 0] / metre[:, None, None]
    moved = project(found.posed, found.K) - project(true.posed, given["K"])
    tips = torch.tensor([4, 8, 12, 16, 20])
    nearest = torch.cdist(true.landmarks[:, tips], true.posed).argmin(2)
    at_tips = moved.gather(1, nearest[..., None].expand(-1, -1, 2))
    # a tip's skin lies some millimetres from the tip, and turns about it
    assert float((at_tips - wanted[:, tips]).norm(dim=-1).median()) < 4
    assert float(wanted[:, tips].norm(dim=-1).median()) > 2


def test_a_hand_turned_in_the_picture_is_seen_as_wrongly(hand, errors):
    choice = torch.tensor([0, 3, 5])
    centred = {"K": torch.tensor([[500.0, 0, 0], [0, 500, 0], [0, 0, 1]]).expand(3, 3, 3)}
    straight = seen(hand, people(hand) | centred, errors, choice)[1]
    rotated = seen(hand, people(hand, turn=1.2) | centred, errors, choice)[1]
    torch.testing.assert_close(rotated.posed, straight.posed @ about_axis(1.2).T, atol=1e-4, rtol=0)


def test_a_hand_borrows_from_hands_that_look_alike(hand, errors):
    given = people(hand)
    true = pose_hands(hand, *(given[key] for key in ("shape", "angles", "orientation", "translation")))
    far = looks(true.landmarks, picture_frames(true.landmarks)) + 1.0

    def table(near):
        """The hands themselves with one lens, `ALIKE` strangers with another."""
        lens = torch.cat([torch.full((ALIKE, 2), 0.1), torch.full((ALIKE, 2), 0.7)])
        rows = torch.cat([far[near].expand(ALIKE, -1) - 1.0, far[near].expand(ALIKE, -1)])
        nothing = {name: getattr(errors, name)[:1].expand(2 * ALIKE, *getattr(errors, name).shape[1:]) * 0
                   for name in ("angles", "turn", "shape", "place")}  # fmt: skip
        return MeasuredErrors(looks=rows, lens=lens, **surface_fields(hand), kept=errors.kept, **nothing)

    for near in range(3):
        found = seen(hand, given, table(near), torch.full((3,), ALIKE - 1))[1]
        assert math.log(float(found.K[near, 0, 0]) / 500) == pytest.approx(0.1, abs=1e-4)
        torch.testing.assert_close(found.K[:, :2, 2], given["K"][:, :2, 2])


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
