"""BVH, the skeletons of motion capture: the fingers of one of its hands."""

import math
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel
from oasis_warp.core.types import PosedHand, Side
from oasis_warp.motion.motion import angles_of_bones

FINGERS = {"index": "index", "middle": "middle|mid", "little": "little|pinky|pinkie", "ring": "ring", "thumb": "thumb"}
"""Ours in the hand model's order, and what skeletons call them."""
SIDES = {"left": r"left|^l[_.\- ]|[_.\- ]l$|[_.\- ]l[_.\- ]", "right": r"right|^r[_.\- ]|[_.\- ]r$|[_.\- ]r[_.\- ]"}
MAX_JOINTS = 1000


class Bone(NamedTuple):
    """A joint of the skeleton."""

    name: str
    parent: int
    """-1 for the root."""
    offset: tuple[float, float, float]
    """From the parent at rest."""
    channels: tuple[str, ...]
    first: int
    """Its first number in a frame."""


class Skeleton(NamedTuple):
    """A BVH file."""

    bones: list[Bone]
    """Ends of chains too, without a name."""
    frames: Float[Tensor, "T C"]
    fps: float


def read_bvh(text: str) -> Skeleton:
    """The skeleton and its motion.

    Raises:
        ValueError: it is no BVH.
    """
    head, found, tail = text.partition("MOTION")
    if not head.lstrip().startswith("HIERARCHY") or not found:
        raise ValueError("HIERARCHY and MOTION are expected")
    bones = _read_bones(iter(head.split()[1:]))
    rates = re.match(r"\s*Frames:\s*(\d+)\s*Frame Time:\s*(\S+)\s", tail)
    if rates is None or float(rates[2]) <= 0:
        raise ValueError("Frames and Frame Time are expected after MOTION")
    size = sum(len(bone.channels) for bone in bones)
    numbers = np.array(tail[rates.end() :].split(), dtype=np.float64)
    if len(numbers) != int(rates[1]) * size or not size:
        raise ValueError(f"{rates[1]} frames of {size} numbers are expected, not {len(numbers)} numbers")
    return Skeleton(bones, torch.from_numpy(numbers.reshape(-1, size)), 1 / float(rates[2]))


def _read_bones(words: Iterator[str]) -> list[Bone]:
    bones: list[Bone] = []
    open_, used, name = [-1], 0, ""
    for word in words:
        if word in ("ROOT", "JOINT"):
            name = next(words, "")
        elif word == "End":
            name = next(words, "") and ""
        elif word == "{":
            bones.append(Bone(name, open_[-1], (0.0, 0.0, 0.0), (), used))
            open_.append(len(bones) - 1)
        elif word == "}" and len(open_) > 1:
            open_.pop()
        elif word == "OFFSET" and bones:
            bones[-1] = bones[-1]._replace(offset=tuple(float(next(words, "")) for _ in range(3)))
        elif word == "CHANNELS" and bones and not bones[-1].channels:
            channels = tuple(next(words, "") for _ in range(min(int(next(words, "")), 6)))
            bones[-1] = bones[-1]._replace(channels=channels)
            used += len(channels)
        else:
            raise ValueError(f"{word[:40]!r} is not expected in HIERARCHY")
        if len(bones) > MAX_JOINTS:
            raise ValueError(f"at most {MAX_JOINTS} joints are expected")
    return bones


def hand_angles(hand: HandModel, rest: PosedHand, skeleton: Skeleton, side: Side) -> Float[Tensor, "T 15 3"]:
    """Joint angles [rad] of the hand of this `side`.

    Its wrist and knuckles at rest are laid on ours; every bone then points where the skeleton's does.

    Args:
        hand: The model of this side.
        rest: Its shape at rest.
        skeleton: Any that names its fingers.
        side: Which of its hands; a skeleton that names no sides has one.

    Raises:
        ValueError: no such hand.
    """
    chains = {bone: joint for bone, joint in enumerate(_finger_joints(skeleton, side), start=1) if joint is not None}
    if any(bone not in chains for bone in (1, 4, 7, 10)):
        raise ValueError(f"fingers of a {side} hand are expected, named such as LeftHandIndex1 or index_01_l")
    wrist = skeleton.bones[chains[4]].parent
    while wrist >= 0 and _is_palm(skeleton.bones[wrist].name):
        wrist = skeleton.bones[wrist].parent
    if wrist < 0:
        raise ValueError("a wrist above the fingers is expected")
    places = _rest_places(skeleton)
    knuckles = [bone for bone in (1, 4, 7, 10) if bone in chains]
    ours = rest.joints.double()
    aligning = _aligning_rotation(places[[chains[bone] for bone in knuckles]] - places[wrist], ours[knuckles] - ours[0])
    world = _world_rotations(skeleton)
    rotations = torch.eye(3, dtype=torch.float64).repeat(len(world), 16, 1, 1)
    for bone in range(1, 16):
        if bone not in chains:
            rotations[:, bone] = rotations[:, hand.parents[bone]]
            continue
        joint = chains[bone]
        ahead = ours[bone + 1] if bone % 3 else rest.tips[TIP_JOINTS.index(bone)].double()
        direction = aligning @ _direction(skeleton, places, joint)
        moved = aligning @ (world[:, wrist].mT @ world[:, joint]) @ aligning.T
        rotations[:, bone] = moved @ _shortest(ahead - ours[bone], direction)
    return angles_of_bones(hand, rotations)


def _is_palm(name: str) -> bool:
    return bool(re.search(r"carpal|inhand", name.lower()))


def _finger_joints(skeleton: Skeleton, side: Side) -> list[int | None]:
    """The skeleton's joint for each of our bones 1 to 15."""
    # Words are told apart, as in LeftHandIndex1, LThumb and mixamorig:LeftHand.
    names = [re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=\b[LR])(?=[A-Z][a-z])", "_", bone.name.split(":")[-1]).lower()
             for bone in skeleton.bones]  # fmt: skip
    sided = any(re.search(pattern, name) for name in names for pattern in SIDES.values())
    found: list[int | None] = []
    for finger, words in FINGERS.items():
        chain = [
            k for k, name in enumerate(names)
            if re.search(words, name) and (not sided or re.search(SIDES[side], name))
            and (finger == "thumb" or not _is_palm(name))
        ]  # fmt: skip
        found += [*chain[:3], *[None] * (3 - len(chain[:3]))]
    return found


def _rest_places(skeleton: Skeleton) -> Float[Tensor, "B 3"]:
    places = torch.zeros(len(skeleton.bones), 3, dtype=torch.float64)
    for k, bone in enumerate(skeleton.bones):
        places[k] = torch.tensor(bone.offset, dtype=torch.float64) + (places[bone.parent] if bone.parent >= 0 else 0)
    return places


def _direction(skeleton: Skeleton, places: Tensor, joint: int) -> Tensor:
    """Along a bone at rest, to the joint that follows; a last one goes on as the one before."""
    after = [k for k, bone in enumerate(skeleton.bones) if bone.parent == joint]
    along = places[after[0]] - places[joint] if after else places.new_zeros(3)
    return along if float(along.norm()) > 0 else places[joint] - places[skeleton.bones[joint].parent]


def _world_rotations(skeleton: Skeleton) -> Float[Tensor, "T B 3 3"]:
    """Rotation of every joint from rest, in the skeleton's world."""
    axes = dict(zip("XYZ", torch.eye(3, dtype=torch.float64), strict=True))
    rotations: list[Tensor] = []
    for bone in skeleton.bones:
        world = torch.eye(3, dtype=torch.float64).expand(len(skeleton.frames), 3, 3)
        if bone.parent >= 0:
            world = rotations[bone.parent]
        for k, channel in enumerate(bone.channels):
            if channel.endswith("rotation"):
                angles = skeleton.frames[:, bone.first + k] * (math.pi / 180)
                world = world @ rotation.from_axis_angle(axes[channel[0]].expand(len(angles), 3), angles)
        rotations.append(world)
    return torch.stack(rotations, 1)


def _aligning_rotation(points: Float[Tensor, "N 3"], targets: Float[Tensor, "N 3"]) -> Float[Tensor, "3 3"]:
    """The rotation that brings points nearest to the directions of others (Kabsch 1976)."""
    u, _, vh = torch.linalg.svd(targets.T @ points)
    sign = torch.det(u @ vh)
    return u @ torch.diag(torch.stack([sign.new_ones(()), sign.new_ones(()), sign])) @ vh


def _shortest(start: Tensor, end: Tensor) -> Float[Tensor, "3 3"]:
    """The rotation by the smallest angle that turns one direction to another."""
    a, b = start / start.norm(), end / end.norm()
    axis = torch.linalg.cross(a, b)
    sine = axis.norm()
    if float(sine) < 1e-9:
        return torch.eye(3, dtype=a.dtype)
    return rotation.from_axis_angle(axis / sine, torch.atan2(sine, a @ b))
