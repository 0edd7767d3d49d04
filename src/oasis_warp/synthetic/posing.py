"""Pose a batch of people, dress them, and put them before their cameras."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.hand.correctives import corrective_coefficients
from oasis_warp.synthetic.body import ARM_LENGTH, ARM_ROWS, Body, arm_rows
from oasis_warp.synthetic.contact import bundled_skeleton
from oasis_warp.synthetic.people import Person
from oasis_warp.synthetic.stage import View
from oasis_warp.synthetic.wardrobe import AWAY, Clothes, bands, sleeves

ARM_BEND = 0.15
"""Share of the forearm over which it bends at the wrist."""
_LAST_JOINTS = (15, 3, 6, 12, 9)
"""Of thumb, index, middle, ring, little: they carry the tips."""


class Posed(NamedTuple):
    """A batch of dressed hands in the frames of their cameras [m]."""

    vertices: Float[Tensor, "B V 3"]
    """In the order of `Body`."""
    landmarks: Float[Tensor, "B 21 3"]
    translation: Float[Tensor, "B 3"]
    """Of the hand's frame: with the view's rotation it is the pose."""
    focal: Float[Tensor, "B"]
    """For a picture one unit wide."""
    center: Float[Tensor, "B 3"]
    """Middle of the hand."""
    radius: Float[Tensor, "B"]
    """Of a ball round it that holds the hand."""


def arm_turns(bends: np.ndarray) -> np.ndarray:
    """Rotations of the arm's rings, [B, R, 3, 3], for bends at the wrist about axes with lengths [rad], [B, 3]."""
    share = np.minimum(1.0, np.linspace(0, 1, ARM_ROWS + 1)[1:] / ARM_BEND)
    lengths = np.linalg.norm(bends, axis=1)
    x, y, z = (bends / np.maximum(lengths, 1e-12)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 1, 3, 3)
    angles = (lengths[:, None] * share)[..., None, None]
    return np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * cross @ cross


def pose_people(
    body: Body, people: list[Person], angles: np.ndarray, bends: np.ndarray, views: list[View], clothes: list[Clothes]
) -> Posed:
    """Skin the hands with their pose correctives, grow arms, lay clothes on, and fit the cameras.

    Args:
        body: On the people's device.
        people: One an image.
        angles: Of all joints [rad], [B, 16, 3].
        bends: Of the wrist [rad], [B, 3].
        views: One an image.
        clothes: One an image.
    """
    device, hand = people[0].rest.device, body.hand
    on_device = lambda a: torch.from_numpy(np.ascontiguousarray(a)).float().to(device)  # noqa: E731
    joints = torch.stack([p.joints for p in people])
    rotation, shift = bundled_skeleton().transforms(angles, joints.double().cpu().numpy())
    rotation, shift = on_device(rotation), on_device(shift)
    coefficients = torch.stack([corrective_coefficients(hand, on_device(a[1:])) for a in angles])
    rest = torch.stack([p.rest for p in people])
    rest = rest + (coefficients @ hand.corrective_basis.flatten(0, 1).T).unflatten(1, (-1, 3))
    bony = torch.tensor([0.4 + 0.9 * p.identity.bony for p in people], device=device)
    bent = on_device(1 - np.cos(np.maximum(angles[:, 1:, 0] + hand.rest_bend[1:].cpu().numpy(), 0)))
    rise = (bent * bony[:, None]) @ body.knuckle_rise.T
    rest = rest + body.normals[: body.n_hand] * rise[..., None]
    blended = hand.weights @ torch.cat([rotation.flatten(2), shift], 2)  # B V 12
    skinned = (blended[..., :9].unflatten(2, (3, 3)) * rest[:, :, None]).sum(-1) + blended[..., 9:]

    girth = torch.tensor([p.identity.arm_girth for p in people], device=device)
    arm = arm_rows(skinned[:, hand.rim], on_device(arm_turns(bends)), girth)
    rows = torch.cat([skinned[:, hand.rim][:, None], arm], 1)
    finger = torch.tensor([max(p.identity.ring_finger, 0) for p in people], device=device)
    ring_joint = 3 * finger + 1
    each = torch.arange(len(people), device=device)
    ring = torch.stack([p.ring for p in people])
    ring = (rotation[each, ring_joint][:, None] * ring[:, :, None]).sum(-1) + shift[each, ring_joint][:, None]
    worn = [sleeves(rows, clothes).flatten(1, 2), bands(rows, clothes).flatten(1, 2), ring]
    wears = [
        [c.sleeve_start < ARM_LENGTH for c in clothes],
        [c.band_start < ARM_LENGTH for c in clothes],
        [p.identity.ring_finger >= 0 for p in people],
    ]

    turn = on_device(np.stack([v.rotation for v in views]))
    seen = (turn[:, None] * skinned[:, :, None]).sum(-1)
    low, high = seen.amin(1), seen.amax(1)
    middle = (low + high) / 2
    extent = (high - low)[:, :2].amax(1)
    distance = on_device([v.distance for v in views])
    shifts = on_device(np.stack([v.shift for v in views]))
    fill = on_device([v.fill for v in views])
    focal = fill * distance / extent
    off = torch.cat([shifts * (extent / fill)[:, None], distance[:, None]], 1)
    translation = off - middle
    move = lambda points: (turn[:, None] * points[:, :, None]).sum(-1) + translation[:, None]  # noqa: E731
    away = torch.tensor(AWAY, device=device)
    parts = [seen + translation[:, None], move(arm.flatten(1, 2))]
    for points, there in zip(worn, wears, strict=True):
        parts.append(torch.where(torch.tensor(there, device=device)[:, None, None], move(points), away))

    tips = torch.stack([p.tips for p in people])
    last = torch.tensor(_LAST_JOINTS, device=device)
    bone_points = torch.cat([joints, tips], 1)
    carriers = torch.cat([torch.arange(16, device=device), last])
    marks = (rotation[:, carriers] * bone_points[:, :, None]).sum(-1) + shift[:, carriers]
    return Posed(
        torch.cat(parts, 1),
        move(marks[:, hand.keypoint_index]),
        translation,
        focal,
        middle + translation,
        (seen - middle[:, None]).norm(dim=-1).amax(1),
    )
