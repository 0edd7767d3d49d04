"""Folded fingers are drawn to the palm and the thumb to the finger that it hides, and nothing else is."""

import numpy as np
import pytest

from oasis_warp.estimation.finger_contact import FingerContact
from oasis_warp.hand.kinematics import bundled_kinematics
from oasis_warp.hand.poses import named_pose

BEFORE_PALM = np.array([-0.06, -0.5, 0.02])
"""A camera that looks at the palm [m]."""


@pytest.fixture(scope="module")
def kinematics():
    return bundled_kinematics()


@pytest.fixture(scope="module")
def contact(kinematics):
    return FingerContact(kinematics)


def free_angles(hand, kinematics, name):
    return named_pose(hand, name).double().numpy()[kinematics.dofs[:, 0] - 1, kinematics.dofs[:, 1]]


def posed(kinematics, angles, shape=None):
    return kinematics.pose_joints(angles, np.zeros(40) if shape is None else shape)


@pytest.mark.parametrize(
    ("name", "count"), [("fist", 5), ("point", 4), ("thumbs_up", 4), ("pinch", 0), ("ok", 0), ("open", 0)]
)
def test_as_many_contacts_as_a_person_sees(hand, kinematics, contact, name, count):
    """A ring of thumb and index is no contact of the index with the palm."""
    joints = posed(kinematics, 0.95 * free_angles(hand, kinematics, name))
    assert np.count_nonzero(contact.term(joints, BEFORE_PALM).residual) == count


def test_a_fist_that_is_a_tenth_open_is_drawn_shut(hand, kinematics, contact):
    angles = free_angles(hand, kinematics, "fist")
    tight, loose = (contact.term(posed(kinematics, share * angles), BEFORE_PALM).residual[:4] for share in (1.0, 0.9))
    assert tight.max() < 0 and loose.min() > 1


def test_the_gradient_is_that_of_the_cost(hand, kinematics, contact):
    """But for the normals of the palm near its knuckles, and how far fingers are folded, which count as constants."""
    angles, shape = 0.97 * free_angles(hand, kinematics, "fist"), np.random.default_rng(0).normal(0, 0.5, 40)
    term = contact.term(posed(kinematics, angles, shape), BEFORE_PALM)
    gradient, step = 2 * term.jacobian.T @ term.residual, 1e-7

    def cost(k, by):
        change = np.zeros(len(gradient))
        change[k] = by
        joints = posed(kinematics, angles + change[: len(angles)], shape + change[len(angles) :])
        return contact.term(joints, BEFORE_PALM).cost

    numeric = np.array([(cost(k, step) - cost(k, -step)) / (2 * step) for k in range(len(gradient))])
    assert np.linalg.norm(numeric - gradient) < 0.05 * np.linalg.norm(numeric)
