from dataclasses import replace

import numpy as np
import pytest

from oasis_warp.estimation.gesture_prior import gesture_prior
from oasis_warp.hand.kinematics import HandKinematics

WIDTHS = 0.25, 0.2, 0.1


@pytest.fixture(scope="module")
def prior(kinematics):
    return gesture_prior(kinematics, WIDTHS)


def test_the_term_is_the_least_score_and_its_derivative(prior):
    angles = prior.means[5] + 0.3 * np.random.default_rng(0).normal(size=26)
    residual, jacobian = prior.term(angles)
    assert residual @ residual == pytest.approx(prior.scores(angles).min())
    step = 1e-6 * np.random.default_rng(1).normal(size=26)
    np.testing.assert_allclose(prior.term(angles + step)[0] - residual, jacobian @ step, atol=1e-10)


def test_a_given_gesture_is_taken(prior):
    residual, _ = prior.term(prior.means[0], 3)
    assert residual @ residual == pytest.approx(prior.scores(prior.means[0])[3])


def test_hidden_joints_bend_with_those_that_are_seen(kinematics, prior):
    """A normal distribution about a relaxed hand left the hidden ends of a fist's fingers half straight."""
    knuckles = [k for k, (joint, axis) in enumerate(kinematics.dofs) if axis == 0 and joint in (1, 4, 7, 10)]
    ends = [k for k, (joint, axis) in enumerate(kinematics.dofs) if axis == 0 and joint in (2, 5, 8, 11)]
    bent = np.radians(80) - kinematics.rest_bend[[1, 4, 7, 10]]
    hidden = np.setdiff1d(np.arange(26), knuckles)
    completed = []
    for gesture in range(len(prior.costs)):
        angles = np.zeros(26)
        angles[knuckles] = bent
        residual, jacobian = prior.term(angles, gesture)
        angles[hidden] -= np.linalg.lstsq(jacobian[:, hidden], residual, rcond=None)[0]
        completed.append(angles)
    likeliest = min(completed, key=lambda angles: prior.scores(angles).min())
    assert np.degrees(likeliest[ends] + kinematics.rest_bend[[2, 5, 8, 11]]).min() > 70


def test_other_hands_rest_in_another_pose(hand, kinematics):
    """Bends are angles from straight fingers; a hand that rests with bent fingers makes the same gestures."""
    bent = HandKinematics(replace(hand, rest_bend=hand.rest_bend + 0.1))
    flexion = kinematics.dofs[:, 1] == 0
    moved = gesture_prior(kinematics, WIDTHS).means - gesture_prior(bent, WIDTHS).means
    np.testing.assert_allclose(moved[:, flexion], 0.1, atol=1e-6)
    np.testing.assert_array_equal(moved[:, ~flexion], 0)
