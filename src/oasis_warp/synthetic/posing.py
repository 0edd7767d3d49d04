"""Pose and dress a batch of people, and place them in front of their cameras."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.body import Body, arm_rows
from oasis_warp.synthetic.ops.batched_lbs import batched_lbs
from oasis_warp.synthetic.people import Person
from oasis_warp.synthetic.shots import ShotTensors
from oasis_warp.synthetic.wardrobe import HIDDEN_POSITION, bands, sleeves

_LAST_JOINTS = (15, 3, 6, 12, 9)
"""The last joints of thumb, index, middle, ring and little finger, which move the tips."""


class PosedPeople(NamedTuple):
    """A batch of posed and dressed hands in the frames of their cameras [m]."""

    vertices: Float[Tensor, "B V 3"]
    """In the order of `body.Body`."""
    landmarks: Float[Tensor, "B 21 3"]
    translation: Float[Tensor, "B 3"]
    """Translation of the hand's frame; with the view's rotation the hand's pose."""
    focal: Float[Tensor, "B"]
    """Focal length over the width of the picture."""
    center: Float[Tensor, "B 3"]
    """Middle of the hand."""
    radius: Float[Tensor, "B"]
    """Radius of a ball around it that contains the hand."""


@functools.cache
def _hidden_position(device: torch.device) -> Tensor:
    return torch.tensor(HIDDEN_POSITION, device=device)


@functools.cache
def _parent_joints(device: torch.device) -> Tensor:
    """The joints that move the 16 joints and 5 tips."""
    return torch.tensor([*range(16), *_LAST_JOINTS], device=device)


def _rotate(rotations: Tensor, points: Tensor) -> Tensor:
    """Rotate points [B, N, 3] by [B, 3, 3] or [B, N, 3, 3]."""
    rotations = rotations[:, None] if rotations.dim() == 3 else rotations
    return (rotations * points[:, :, None]).sum(-1)


def pose_people(body: Body, people: Sequence[Person], numbers: ShotTensors) -> PosedPeople:
    """Skin the hands with pose correctives, add forearms and clothes, and fit the cameras.

    Args:
        body: On the people's device.
        people: One per image.
        numbers: Numbers of the same images.
    """
    hand = body.hand
    rest, joints, tips, ring = (torch.stack([getattr(p, name) for p in people])
                                for name in ("rest", "joints", "tips", "ring"))  # fmt: skip
    bend = 1 - torch.cos(numbers.angles[..., 0])
    correctives = torch.stack([bend, bend * bend], -1).flatten(1)  # `hand.skinning.corrective_coefficients`
    skinned = batched_lbs(
        rest, hand.corrective_basis, correctives, body.normals[: body.n_hand], body.knuckle_rise, numbers.knuckles,
        hand.weights, numbers.rotations, numbers.translations,
    )  # fmt: skip

    rim = skinned[:, hand.rim]
    arm = arm_rows(rim, numbers.arm_rotations, numbers.arm_girth)
    rows = torch.cat([rim[:, None], arm], 1)
    worn = [
        sleeves(rows, numbers.sleeve_start, numbers.sleeve_gap, numbers.sleeve_phases).flatten(1, 2),
        bands(rows, numbers.band_start, numbers.band_width, numbers.band_thickness).flatten(1, 2),
        _rotate(numbers.ring_rotation, ring) + numbers.ring_translation[:, None],
    ]

    rotations, distance, fill = numbers.view_rotation, numbers.view_distance, numbers.view_fill
    seen = _rotate(rotations, skinned)
    low, high = seen.aminmax(dim=1)
    middle = (low + high) / 2
    extent = (high - low)[:, :2].amax(1)
    focal = fill * distance / extent
    off = torch.cat([numbers.view_shift * (extent / fill)[:, None], distance[:, None]], 1)
    translation = off - middle
    move = lambda points: _rotate(rotations, points) + translation[:, None]  # noqa: E731
    parts = [seen + translation[:, None], move(arm.flatten(1, 2))]
    for k, points in enumerate(worn):
        parts.append(torch.where(numbers.wears[:, k, None, None] > 0, move(points), _hidden_position(points.device)))

    parent_joints = _parent_joints(rest.device)[hand.keypoint_index]
    points = torch.cat([joints, tips], 1)[:, hand.keypoint_index]
    marks = _rotate(numbers.rotations[:, parent_joints], points) + numbers.translations[:, parent_joints]
    return PosedPeople(
        torch.cat(parts, 1),
        move(marks),
        translation,
        focal,
        middle + translation,
        (seen - middle[:, None]).norm(dim=-1).amax(1),
    )
