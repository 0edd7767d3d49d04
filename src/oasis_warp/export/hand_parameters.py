"""The hand's parameters as JSON: shape, pose and camera, ours and as MANO's, and the joints that they give."""

import json
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_pose
from oasis_warp.core.types import HandPose
from oasis_warp.data.output_files import write_file
from oasis_warp.export.request import ExportRequest
from oasis_warp.hand.mano import mirror_mano_pose
from oasis_warp.hand.mano_hand import mano_of_hand_pose
from oasis_warp.hand.skinning import bone_transforms, hand21
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import check_finite

VERSION = 1
LANDMARKS = (
    "wrist",
    *(f"{finger}{k}" for finger in ("thumb", "index", "middle", "ring", "little") for k in range(1, 5)),
)


def write_parameters(request: ExportRequest, path: Path) -> None:
    """docs/export.md explains each key; lengths in metres, angles in radians, the photo camera's axes (OpenCV's).

    Raises:
        InputError: `path` cannot be written.
        ValueError: the pose is not finite.
    """
    avatar, camera = request.avatar, request.avatar.source_camera
    pose = HandPose(*(part.to(avatar.shape) for part in request.pose or avatar.source_pose))
    check_finite(**pose._asdict())
    hand, rest = avatar.parts[:2]
    points = hand21(avatar.mesh(pose), hand)
    found: dict[str, Any] = {
        "oasis_hand": VERSION,
        "side": avatar.side,
        "hand_model": {"name": hand.name, "licence": hand.licence},
        "shape": dict(zip(hand.shape_names, avatar.shape.tolist(), strict=True)),
        "pose": {
            "angles": {
                name: dict(zip(("flexion", "abduction", "twist"), row, strict=True))
                for name, row in zip(hand.joint_names[1:], pose.angles.tolist(), strict=True)
            },
            "orientation": pose.orientation.tolist(),
            "translation": pose.translation.tolist(),
        },
        "as_mano": {
            "joint_names": list(hand.joint_names),
            "global_orient": rotation.to_vector(pose.orientation[None])[0].tolist(),
            "hand_pose": rotation.to_vector(_local_rotations(hand, rest.joints, pose)).tolist(),
            "transl": pose.translation.tolist(),
            "rest_joints": rest.joints.tolist(),
            **_parameters_of_mano(avatar, pose),
        },
        "landmarks": dict(zip(LANDMARKS, points.tolist(), strict=True)),
        "camera": {
            "viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": camera.width, "height": camera.height,
        },
    }  # fmt: skip
    write_file(path, (json.dumps(found, indent=1, allow_nan=False) + "\n").encode())


def _parameters_of_mano(avatar: Avatar, pose: HandPose) -> dict[str, Any]:
    """What smplx's layer of the avatar's side needs for its hand; empty where the hand is not MANO's."""
    if avatar.hand.origin is None:
        return {}
    left = avatar.side == "left"
    found = mano_of_hand_pose(avatar.hand, avatar.shape, mirror_pose(pose) if left else pose)
    found = mirror_mano_pose(found) if left else found
    return {name: values.tolist() for name, values in found._asdict().items()}


def _local_rotations(hand: HandModel, joints: Float[Tensor, "16 3"], pose: HandPose) -> Float[Tensor, "15 3 3"]:
    """Rotation of each bone but the wrist's in the frame of its parent at rest."""
    world, _ = bone_transforms(hand, joints, pose)
    return world[list(hand.parents[1:])].mT @ world[1:]
