"""The prior of hand shapes."""

import dataclasses

import numpy as np
import torch

from oasis_warp.estimation.shape_prior import ANY, DEVIATION, MEANS, shape_prior


def test_the_palm_of_the_expected_hand_is_as_long_as_a_real_one(hand):
    """The model's own mean hand has .46 of first phalanx to palm, fits to photos .49."""
    means, _ = shape_prior(hand)
    joints = hand.joints + hand.joint_basis @ torch.from_numpy(means).float()
    wrist, knuckle, middle = (joints[hand.joint_names.index(name)] for name in ("wrist", "middle1", "middle2"))
    assert 0.48 < float((middle - knuckle).norm() / (knuckle - wrist).norm()) < 0.52


def test_every_mean_belongs_to_a_coefficient(hand):
    assert set(MEANS) <= set(hand.shape_names)


def test_other_hand_models_keep_their_own_mean(hand):
    other = dataclasses.replace(hand, shape_names=tuple(f"beta{k}" for k in range(40)))
    means, deviations = shape_prior(other)
    assert np.all(means == 0) and np.all(deviations == ANY)
    assert np.all(shape_prior(hand)[1] == DEVIATION)
