"""Named poses on hands of other shapes: skin touches where it touches on the mean hand."""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import PosedHand
from oasis_warp.hand.contact import contact_tables
from oasis_warp.hand.kinematics import HandKinematics, bundled_kinematics
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops.contact import OPPOSED

NEAR = 0.004
"""Distance up to which vertices of the mean hand count as touching, if their normals are `OPPOSED` [m]."""
APART, ALONG = 0.001, 0.005
"""Errors across and along the skin that weigh as much as the changes of angles below [m]."""
CHANGES = np.radians([12.0, 6.0, 6.0])
"""Of flexion, abduction and twist [rad]."""
STEPS = 8
"""Of Gauss and Newton."""


class Touch(NamedTuple):
    """Where the mean hand touches itself in a pose: C pairs of vertices, the nearest of each two patches of skin."""

    one: np.ndarray
    """[C]."""
    other: np.ndarray
    """[C]."""
    apart: np.ndarray
    """From the other to the one [m], [C, 3]."""
    normals: np.ndarray
    """Of the other's skin, [C, 3]."""


def touching_angles(hand: HandModel, rest: PosedHand, angles: np.ndarray, touch: Touch) -> np.ndarray:
    """Angles near the given ones with which the same skin touches as on the mean hand.

    Least squares over the distances of the pairs and the changes of the angles.

    Args:
        hand: Any.
        rest: The hand at rest [m].
        angles: [16, 3] [rad].
        touch: Of the mean hand in that pose.
    """
    if len(touch.one) == 0:
        return angles
    hand = hand.to(torch.device("cpu"))
    own = dataclasses.replace(
        hand, template=rest.vertices.detach().cpu(), joints=rest.joints.detach().cpu(),
        **{name: getattr(hand, name)[..., :0] for name in ("shape_basis", "joint_basis", "tip_basis")},
    )  # fmt: skip
    kinematics, shapeless = HandKinematics(own), np.zeros(0)
    joints, axes = kinematics.dofs.T
    limits = kinematics.limits[joints, axes]
    x = start = angles[joints, axes]
    low, high = np.minimum(limits[:, 0], start), np.maximum(limits[:, 1], start)
    stiff = np.diag(CHANGES[axes] ** -2)
    across = touch.normals[:, :, None] * touch.normals[:, None]
    weigh = across / APART + (np.eye(3) - across) / ALONG
    index = np.concatenate([touch.one, touch.other])
    bulge = kinematics.correctives(angles)[index]
    table = angles.copy()
    for _ in range(STEPS):
        points, slopes = kinematics.vertices(kinematics.pose_all_joints(table, shapeless), index, bulge)
        (one, other), (by_one, by_other) = np.split(points, 2), np.split(slopes, 2)
        error = (weigh @ (one - other - touch.apart)[..., None]).ravel()
        slope = (weigh @ (by_one - by_other)).reshape(len(error), -1)
        left = slope.T @ error + stiff @ (x - start)
        x = np.clip(x - np.linalg.solve(slope.T @ slope + stiff, left), low, high)
        table[joints, axes] = x
    return table


@functools.lru_cache(maxsize=16)
def touch_of_mean_hand(angles: tuple[float, ...]) -> Touch:
    """Where the bundled mean hand touches itself at these 48 angles [rad]."""
    hand, tables = bundled_hand(), contact_tables(torch.device("cpu"))
    kinematics = bundled_kinematics()
    table = np.array(angles).reshape(16, 3)
    points = kinematics.surface(kinematics.pose_all_joints(table, np.zeros(len(hand.shape_names))))
    normals = kinematics.vertex_normals(points)
    one, other = cKDTree(points).query_pairs(NEAR, output_type="ndarray").T
    part, bits = tables.part.numpy(), tables.allowed.numpy()
    a, b = part[one], part[other]
    meets = (bits[a, b >> 5] >> (b & 31)) & 1 == 1
    meets &= (normals[one] * normals[other]).sum(1) < OPPOSED
    one, other, pair = one[meets], other[meets], (a * len(bits) + b)[meets]
    nearest = np.linalg.norm(points[one] - points[other], axis=1).argsort(kind="stable")
    _, first = np.unique(pair[nearest], return_index=True)
    one, other = one[nearest[first]], other[nearest[first]]
    return Touch(one, other, points[one] - points[other], normals[other])
