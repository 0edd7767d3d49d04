"""Named hand poses, and smooth sequences of them."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import did_you_mean
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.rotation import euler_angles, euler_rotations
from oasis_warp.core.types import PosedHand
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand.touching_poses import touch_of_mean_hand, touching_angles

Finger = tuple[float, float, float, float]
"""Flexion of a finger's three joints from the knuckle outwards, and abduction of the knuckle [degrees]."""

Thumb = tuple[float, float, float, float, float]
"""Flexion, abduction and twist of the thumb's base, flexion of its two outer joints [degrees]."""

_FIST: dict[str, Finger] = {
    "index": (79, 98, 64, 4),
    "middle": (82, 95, 63, 1),
    "ring": (81, 98, 64, -1),
    "little": (79, 94, 57, -5),
}

# Flexion is relative to a straight finger. Abduction, and all angles of the thumb's base, are relative to rest and
# positive towards the thumb. Where the thumb touches a finger, the angles give the smallest gap without
# self-intersection.
_THUMBS: dict[str, Thumb] = {
    "open": (-10, 14, 0, 0, 0),
    "relaxed": (8, -4, 0, 14, 16),
    "fist": (22, 15, -11, 40, 47),
    "pinch": (35, 10, -10, 2, 5),
    "thumbs_up": (-12, 18, 0, 0, -6),
    "victory": (38, 21, -16, 40, 45),
    "point": (20, 22, -23, 44, 49),
    "ok": (32, 10, -11, 13, 12),
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
    "ok": {"index": (53, 53, 31, -8), "middle": (8, 12, 6, 0), "ring": (4, 8, 4, -4), "little": (0, 4, 2, -8)},
}  # fmt: skip

POSE_NAMES = ("rest", *_FINGERS)


def named_pose(hand: HandModel, name: str, rest: PosedHand | None = None) -> Float[Tensor, "15 3"]:
    """Joint angles [rad] of the pose called `name`, one of `POSE_NAMES`, as in `HandPose.angles`.

    Args:
        hand: Any.
        name: Of the pose.
        rest: The surface at rest that takes the pose: it touches itself where the bundled mean hand does
            (`hand.touching_poses`). The angles of the table when not given.

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
