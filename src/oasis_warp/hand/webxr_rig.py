"""The skeleton of a hand with WebXR's 25 joints (www.w3.org/TR/webxr-hand-input-1), in which engines pose it."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose, PosedHand, Side
from oasis_warp.hand.skinning import bone_transforms

TO_WEBXR: dict[str, tuple[tuple[float, float, float], ...]] = {
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
"""Rotation from the frame of a hand of this side: fingers to -z, back to y, a right hand's thumb to -x."""
FINGERS = {"thumb": "thumb", "index-finger": "index", "middle-finger": "middle", "ring-finger": "ring",
           "pinky-finger": "little"}  # fmt: skip
"""WebXR's names, and ours."""
METACARPALS = {"index": 68.12 / 39.78, "middle": 64.60 / 44.63, "ring": 57.95 / 41.37, "little": 53.69 / 32.74}
"""Length of the bone in the palm over that of the first phalanx (Buryanov and Kotiuk 2010, means of 66 adults)."""


class Rig(NamedTuple):
    """Joints, each fixed to a bone of the hand model; -z leads to the next joint, y to the back of the hand."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """-1 for the wrist; parents come first."""
    bones: tuple[int, ...]
    """Bone of the hand model that a joint moves with."""
    bind: Float[Tensor, "J 4 4"]
    """From the joint's frame at rest to that of the file [m]."""


def webxr_rig(hand: HandModel, rest: PosedHand, side: Side) -> Rig:
    """The rig of a hand model and its shape at rest, both of this `side`.

    WebXR's joints are those of the model, the tips, and the bases of four bones in the palm, which move with the wrist.
    """
    names, parents, bones, points, axes = ["wrist"], [-1], [0], [rest.joints[0]], []
    for k, (webxr, finger) in enumerate(FINGERS.items()):
        first = hand.joint_names.index(finger + "1")
        chain = [first, first + 1, first + 2]
        places = [*rest.joints[chain], rest.tips[k]]
        parts = ["phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip"]
        moved_by = [*chain, chain[-1]]
        if finger == "thumb":
            parts[:2] = ["metacarpal", "phalanx-proximal"]
        else:
            back = normalize(rest.joints[0] - places[0], dim=0)
            places.insert(0, places[0] + METACARPALS[finger] * (places[1] - places[0]).norm() * back)
            parts.insert(0, "metacarpal")
            moved_by.insert(0, 0)
        parents += [0, *range(len(names), len(names) + len(parts) - 1)]
        names += [f"{webxr}-{part}" for part in parts]
        bones += moved_by
        points += places
        axes += [hand.pose_axes[bone or first, 0] for bone in moved_by]
    wrist_axis = hand.pose_axes[hand.joint_names.index("middle1"), 0]
    frames = _frames(torch.stack(points), torch.stack([wrist_axis, *axes]), names, parents)
    to_file = torch.tensor(TO_WEBXR[side]).to(frames)
    bind = torch.eye(4).to(frames).repeat(len(names), 1, 1)
    bind[:, :3, :3], bind[:, :3, 3] = to_file @ frames, torch.stack(points) @ to_file.T
    return Rig(tuple(names), tuple(parents), tuple(bones), bind)


def _frames(
    points: Float[Tensor, "J 3"], axes: Float[Tensor, "J 3"], names: list[str], parents: list[int]
) -> Float[Tensor, "J 3 3"]:
    """Columns x, y, z of each joint, in the hand's frame; axes are those about which fingers close."""
    ahead = [parents.index(j) if j in parents else j for j in range(len(names))]
    ahead[0] = names.index("middle-finger-metacarpal")
    along = points[ahead] - points
    tips = [j for j, name in enumerate(names) if name.endswith("tip")]
    along[tips] = along[[parents[j] for j in tips]]
    z = normalize(-along, dim=1)
    x = normalize(-axes + (axes * z).sum(1, keepdim=True) * z, dim=1)
    return torch.stack([x, torch.linalg.cross(z, x), z], 2)


def local_bind(rig: Rig) -> Float[Tensor, "J 4 4"]:
    """Each joint at rest in the frame of its parent; the wrist in that of the file."""
    upper = torch.stack([torch.eye(4).to(rig.bind) if p < 0 else rig.bind[p] for p in rig.parents])
    return torch.linalg.solve(upper, rig.bind)


def local_quats(
    rig: Rig, hand: HandModel, rest: PosedHand, angles: Float[Tensor, "T 15 3"], side: Side
) -> Float[Tensor, "T J 4"]:
    """Rotation of each joint in the frame of its parent, wxyz, in poses of these joint angles [rad].

    The hand stays in place: orientation and translation of a pose belong to no joint. Neighbours in time have the same
    sign, so that they can be interpolated.
    """
    n = len(angles)
    at_origin = HandPose(angles, torch.eye(3).expand(n, 3, 3).to(angles), angles.new_zeros(n, 3))
    rotations, _ = bone_transforms(hand, rest.joints, at_origin)
    to_file = torch.tensor(TO_WEBXR[side]).to(angles)
    world = to_file @ rotations[:, list(rig.bones)] @ to_file.T @ rig.bind[:, :3, :3]
    upper = torch.stack([torch.eye(3).expand(n, 3, 3).to(world) if p < 0 else world[:, p] for p in rig.parents], 1)
    quats = rotation.from_matrix(upper.mT @ world)
    for t in range(1, n):
        quats[t] = torch.where((quats[t] * quats[t - 1]).sum(-1, keepdim=True) < 0, -quats[t], quats[t])
    return quats
