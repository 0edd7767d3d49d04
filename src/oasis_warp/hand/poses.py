"""Named hand poses, on hands of any shape, and smooth sequences of them.

The tables hold the poses of the bundled mean hand. On a hand of another shape the angles change until skin touches
where it touches on the mean hand.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.core.errors import did_you_mean
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.rotation import euler_angles, euler_rotations
from oasis_warp.core.types import PosedHand
from oasis_warp.hand.contact import contact_tables
from oasis_warp.hand.kinematics import HandKinematics, bundled_kinematics
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops.contact import OPPOSED

Finger = tuple[float, float, float, float]
"""Flexion of a finger's three joints from the knuckle outwards, and abduction of the knuckle [degrees]."""

Thumb = tuple[float, float, float, float, float]
"""Flexion, abduction and twist of the thumb's base, flexion of its two outer joints [degrees]."""

_FIST: dict[str, Finger] = {
    "index": (86, 103, 52, 1),
    "middle": (86, 110, 57, -1),
    "ring": (79, 110, 62, 4),
    "little": (70, 106, 62, 6),
}

# Flexion is relative to a straight finger. Abduction, and all angles of the thumb's base, are relative to rest and
# positive towards the thumb. Where the thumb touches a finger, the angles give the smallest gap without
# self-intersection. With the index bent as far as the others, light came through a fist along all fingers.
_THUMBS: dict[str, Thumb] = {
    "open": (-25, -5, 18, 0, 6),
    "relaxed": (8, -4, 0, 14, 16),
    "fist": (28, 15, -14, 45, 68),
    "pinch": (35, 10, -10, 2, 5),
    "thumbs_up": (-14, 16, 0, 3, -10),
    "victory": (43, 15, -18, 37, 44),
    "point": (33, 17, -18, 43, 61),
    "ok": (12, 0, 1, 37, 44),
}

_FINGERS: dict[str, dict[str, Finger]] = {
    "open": {"index": (0, 0, 0, 8), "middle": (0, 0, 0, 2), "ring": (0, 0, 0, -4), "little": (0, 0, 0, -10)},
    "relaxed": {
        "index": (22, 28, 14, 0), "middle": (28, 34, 18, 0), "ring": (32, 38, 20, 0), "little": (34, 40, 20, 2),
    },
    "fist": _FIST,
    "pinch": {
        "index": (54, 47, 22, 2), "middle": (32, 34, 20, 0), "ring": (28, 30, 18, -2), "little": (24, 26, 16, -4),
    },
    "thumbs_up": _FIST,
    "victory": {**_FIST, "index": (2, 6, 4, 12), "middle": (2, 6, 4, -8)},
    "point": {**_FIST, "index": (2, 6, 4, 0)},
    "ok": {"index": (48, 59, 37, 3), "middle": (6, 12, 8, 0), "ring": (2, 8, 6, -4), "little": (-2, 5, 4, -10)},
}  # fmt: skip

POSE_NAMES = ("rest", *_FINGERS)
"""Names of poses."""

NEAR = 0.004
"""Distance up to which vertices of the mean hand count as touching, if their normals are `OPPOSED` [m]."""
APART, ALONG = 0.001, 0.005
"""Errors across and along the skin that weigh as much as the changes of angles below [m]."""
CHANGES = np.radians([12.0, 6.0, 6.0])
"""Sigmas of changes of flexion, abduction and twist [rad]."""
STEPS = 8
"""Gauss-Newton steps."""


def named_pose(hand: HandModel, name: str, rest: PosedHand | None = None) -> Float[Tensor, "15 3"]:
    """Joint angles [rad] of the pose called `name`, one of `POSE_NAMES`, as in `HandPose.angles`.

    Args:
        hand: Any.
        name: Name of the pose.
        rest: The surface at rest that takes the pose: it touches itself where the bundled mean hand does
            (`touching_angles`). The angles of the table when not given.

    Raises:
        ValueError: no pose has that name.
    """
    if name not in POSE_NAMES:
        hint = did_you_mean(name, POSE_NAMES)
        raise ValueError(f"pose: expected one of {', '.join(POSE_NAMES)}, got {name!r}.{hint and ' '}{hint}")
    if name == "rest":
        return torch.zeros_like(hand.pose_axes[1:, 0])
    bundled = _angles(bundled_hand(), name)
    angles = bundled if hand.origin is None else _angles(hand, name)
    if rest is not None:
        touch = touch_of_mean_hand(tuple(bundled.flatten().tolist()))
        angles = torch.from_numpy(touching_angles(hand, rest, angles.numpy(), touch))
    return angles[1:].to(hand.pose_axes)


def _angles(hand: HandModel, name: str) -> Float[Tensor, "16 3"]:
    """Those of the tables, float64 on the CPU."""
    degrees = torch.zeros(16, 3, dtype=torch.float64)
    for finger, (knuckle, middle, end, abduction) in _FINGERS[name].items():
        first = hand.joint_names.index(finger + "1")
        degrees[first, 1] = abduction
        degrees[first : first + 3, 0] = torch.tensor([knuckle, middle, end])
    first = hand.joint_names.index("thumb1")
    *base, middle, end = _THUMBS[name]
    degrees[first] = torch.tensor(base)
    degrees[first + 1 : first + 3, 0] = torch.tensor([middle, end])
    angles = degrees.deg2rad()
    rest = torch.zeros_like(angles) if hand.origin is None else hand.origin.rest_angles
    # 0 is a straight finger in the table, the rest pose in the model.
    angles[:, 0] -= hand.rest_bend.cpu().double() - rest[:, 0]
    if hand.origin is not None:
        angles = euler_angles(euler_rotations(angles) @ euler_rotations(rest).mT)
    return angles


def pose_sequence(
    hand: HandModel, names: Sequence[str], frames_per_transition: int, rest: PosedHand | None = None
) -> list[Float[Tensor, "15 3"]]:
    """Joint angles [rad] of a loop through the named poses, `frames_per_transition` for each one.

    Frame `i * frames_per_transition` is pose `names[i]`. Angles ease from each pose to the next by half a cosine, and
    from the last to the first, so the sequence repeats without a jump. `rest` is that of `named_pose`.

    Raises:
        ValueError: an unknown name, no name, or fewer than one frame a transition.
    """
    if not names:
        raise ValueError("names: expected at least one pose, got none.")
    if frames_per_transition < 1:
        raise ValueError(f"frames_per_transition: expected 1 or more, got {frames_per_transition}.")
    poses = [named_pose(hand, name, rest) for name in names]
    frames = []
    for start, end in zip(poses, [*poses[1:], poses[0]], strict=True):
        for frame in range(frames_per_transition):
            blend = 0.5 - 0.5 * math.cos(math.pi * frame / frames_per_transition)
            frames.append(torch.lerp(start, end, blend))
    return frames


class Touch(NamedTuple):
    """Where the mean hand touches itself in a pose: C pairs of vertices, the nearest of each two patches of skin."""

    one: np.ndarray
    """[C]."""
    other: np.ndarray
    """[C]."""
    apart: np.ndarray
    """From the other to the one [m], [C, 3]."""
    normals: np.ndarray
    """Normals of the other's skin, [C, 3]."""


def touching_angles(hand: HandModel, rest: PosedHand, angles: np.ndarray, touch: Touch) -> np.ndarray:
    """Angles near the given ones with which the same skin touches as on the mean hand.

    Least squares over the distances of the pairs and the changes of the angles.

    Args:
        hand: Any.
        rest: The hand at rest [m].
        angles: [16, 3] [rad].
        touch: Touch of the mean hand in that pose.
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
