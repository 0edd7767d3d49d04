"""Print how well the bundled hand bends, with and without its pose correctives, as a Markdown table.

Run it as `python asset_build/measure_hand.py`.
"""

import dataclasses

import numpy as np
import torch
from elastic_hand import truths
from hand_build.quality import closed, section_girth, self_crossings, signed_volume

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose, PosedHand
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import bone_transforms, rest_hand, skin
from oasis_warp.hand.template import bundled_hand

GIRTH_JOINT = "index2"
GIRTH_ANGLES = (0, 30, 60, 80)
N_GESTURES, SEED = 12, 77


def at_origin(hand: HandModel, angles: torch.Tensor) -> tuple[PosedHand, HandPose]:
    """The mean hand with joint `angles`, not moved as a whole."""
    pose = HandPose(angles, torch.eye(3).to(angles), torch.zeros(3).to(angles))
    return skin(hand, rest_hand(hand, torch.zeros(len(hand.shape_names)).to(angles)), pose), pose


def pose_row(hand: HandModel, name: str) -> tuple[float, int]:
    """Volume [cm^3] and crossing edges of a named pose."""
    vertices = at_origin(hand, named_pose(hand, name))[0].vertices.numpy()
    faces = hand.faces.numpy()
    return 1e6 * signed_volume(*closed(vertices, faces, hand.rim.numpy())), self_crossings(vertices, faces)


def joint_crossings(hand: HandModel, share: float) -> int:
    """Crossing edges, summed over all joints, each bent alone to `share` of its limit."""
    total = 0
    for joint in range(15):
        angles = torch.zeros_like(hand.pose_axes[1:, 0])
        angles[joint, 0] = share * hand.pose_limits[joint + 1, 0, 1]
        total += self_crossings(at_origin(hand, angles)[0].vertices.numpy(), hand.faces.numpy())
    return total


def gesture_crossings(hand: HandModel) -> int:
    """Crossing edges, summed over sampled gestures, as drawn and with their parts pushed apart."""
    found = (torch.from_numpy(angles) for angles in truths.gestures(hand, N_GESTURES, SEED))
    return sum(self_crossings(at_origin(hand, angles)[0].vertices.numpy(), hand.faces.numpy()) for angles in found)


def girth(hand: HandModel, degrees: float) -> float:
    """Girth [mm] of a finger at its middle joint, in the plane that halves the bend."""
    joint = hand.joint_names.index(GIRTH_JOINT)
    angles = torch.zeros_like(hand.pose_axes[1:, 0])
    angles[joint - 1, 0] = np.radians(degrees) / 2
    half, _ = bone_transforms(hand, hand.joints, at_origin(hand, angles)[1])
    angles[joint - 1, 0] = np.radians(degrees)
    posed, _ = at_origin(hand, angles)
    normal = (half[joint] @ hand.pose_axes[joint, 2]).numpy()
    return 1e3 * section_girth(posed.vertices.numpy(), hand.faces.numpy(), posed.joints[joint].numpy(), normal)


def main() -> None:
    """Measure and print."""
    full = bundled_hand().to(dtype=torch.float64)
    plain = dataclasses.replace(full, corrective_basis=full.corrective_basis[..., :0])
    print("| pose | volume before [cm^3] | after | crossing edges before | after |\n|---|---|---|---|---|")
    for name in POSE_NAMES:
        (volume, crossings), (volume_after, crossings_after) = pose_row(plain, name), pose_row(full, name)
        print(f"| {name} | {volume:.0f} | {volume_after:.0f} | {crossings} | {crossings_after} |")
    for share in (0.5, 0.75, 1.0):
        before, after = joint_crossings(plain, share), joint_crossings(full, share)
        print(f"| each joint alone at {share:.0%} of its limit | | | {before} | {after} |")
    print(f"| {2 * N_GESTURES} gestures | | | {gesture_crossings(plain)} | {gesture_crossings(full)} |")
    print("\n| girth of the index at its middle joint, bent by | before [mm] | after |\n|---|---|---|")
    for degrees in GIRTH_ANGLES:
        print(f"| {degrees} degrees | {girth(plain, degrees):.1f} | {girth(full, degrees):.1f} |")


if __name__ == "__main__":
    main()
