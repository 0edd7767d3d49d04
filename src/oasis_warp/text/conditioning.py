"""What steers an image generator to a hand in a known pose: depth, mask, normals, edges, and the pose itself."""

import json
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core import surface
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_pixels, mirror_pose
from oasis_warp.core.types import Camera, HandPose, Side
from oasis_warp.data.pictures import to_uint8, write_picture
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.ops import depth_map

View = Literal["palm", "back"]

FINGERS_UP = {
    "palm": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "back": ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
}
"""Rotations from the hand's frame to the camera's."""
FOREARM, WIDENING = 0.3, 1.25
"""Length of the forearm below the wrist [m], beyond the picture's edge, and its girth there over that of the wrist."""
NEAREST, FARTHEST = 1.0, 0.3
"""Grey of the nearest and the farthest point of the hand; the background is 0."""
FACING = (0.5, 0.5, 1.0)
"""Colour of a normal towards the camera, as normal maps have it: x right, y up, z to the viewer."""
EDGES = (100, 200)
"""Canny's thresholds on 8 bits, the usual ones of ControlNet."""


class Conditioning(NamedTuple):
    """A hand of mean shape in a pose, before a camera, and pictures of it that a generator follows."""

    side: Side
    pose: HandPose
    """In the camera's frame; a left hand's describes the mirrored model."""
    camera: Camera
    landmarks: Float[Tensor, "21 2"]
    """Where they are in the pictures [px]."""
    depth: Float[Tensor, "S S"]
    """Nearness: 1 is the nearest point of the hand, 0 the background. The forearm is in it."""
    mask: Float[Tensor, "S S"]
    """1 on hand and forearm."""
    normals: Float[Tensor, "S S 3"]
    """As colours."""


@torch.no_grad()
def make_conditioning(
    hand: HandModel, pose: str = "open", view: View = "palm", side: Side = "right", size: int = 1024
) -> Conditioning:
    """The mean hand with its fingers up, `size` pixels large, and a forearm that leaves the picture.

    Raises:
        ValueError: no such pose.
    """
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1]))
    placed = HandPose(named_pose(hand, pose), torch.tensor(FINGERS_UP[view]), torch.zeros(3))
    posed = skin(hand, rest, placed)
    camera = orbit_camera(posed.vertices, 0.0, size=size)
    forward = camera.viewmat[:3, 3]
    camera, placed = camera._replace(viewmat=torch.eye(4)), placed._replace(translation=forward)
    vertices = posed.vertices + forward
    landmarks = project(camera, _landmarks(hand, placed))[0]
    pictures = _pictures(hand, vertices, placed.orientation[:, 0], camera)
    if side == "left":
        placed, landmarks = mirror_pose(placed), mirror_pixels(landmarks, size)
        depth, mask, normals = (picture.flip(1) for picture in pictures)
        normals[..., 0] = 1 - normals[..., 0]  # to the other side, as the picture
        pictures = depth, mask, normals
    return Conditioning(side, placed, camera, landmarks, *pictures)


def _landmarks(hand: HandModel, pose: HandPose) -> Float[Tensor, "21 3"]:
    """The points that a landmark network finds, in the camera's frame [m]."""
    kinematics = HandKinematics(hand)
    table = np.concatenate([np.zeros((1, 3)), pose.angles.double().numpy()])
    joints = kinematics.pose_all_joints(table, np.zeros(hand.shape_basis.shape[-1]))
    points = torch.from_numpy(kinematics.landmarks(joints)[0]).float()
    return points @ pose.orientation.T + pose.translation


def _pictures(hand: HandModel, vertices: Tensor, outwards: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, mask and normals of the hand with a forearm that grows from its rim along `outwards`."""
    rim = hand.rim
    ring = vertices[rim]
    far = ring.mean(0) + (ring - ring.mean(0)) * WIDENING + FOREARM * outwards
    n, k = len(vertices), torch.arange(len(rim))
    following = k.roll(-1)
    tube = torch.cat(
        [torch.stack([rim[k], n + k, rim[following]], 1), torch.stack([n + k, n + following, rim[following]], 1)]
    )
    whole, faces = torch.cat([vertices, far]), torch.cat([hand.faces, tube.to(hand.faces)])
    seen = depth_map(whole, faces, camera.viewmat, camera.K, camera.width, camera.height)
    mask = (seen.face_ids >= 0).float()
    near, deep = (float(bound) for bound in vertices[:, 2].aminmax())
    depth = NEAREST - (seen.depth - near) / (deep - near) * (NEAREST - FARTHEST)
    normals = surface.vertex_normals(whole, faces)
    corners = normals[faces[seen.face_ids.clamp_min(0).long()].long()]
    facing = torch.nn.functional.normalize((corners * seen.barycentrics[..., None]).sum(-2), dim=-1)
    facing = torch.where(facing[..., 2:] > 0, -facing, facing)  # the rim's winding does not matter
    colors = (1 + facing * torch.tensor([1.0, -1.0, -1.0])) / 2
    return (
        depth.clamp(0, 1) * mask,
        mask,
        torch.where(mask[..., None] > 0, colors, torch.tensor(FACING)),
    )


def write_conditioning(folder: Path, conditioning: Conditioning) -> None:
    """Write depth.png, mask.png, normal.png, canny.png and pose.json into `folder`.

    Raises:
        InputError: they cannot be written.
    """
    grey = [to_uint8(part[..., None].expand(-1, -1, 3)) for part in (conditioning.depth, conditioning.mask)]
    normals = to_uint8(conditioning.normals)
    edges = cv2.Canny(normals.numpy(), *EDGES)
    pictures = {
        "depth": grey[0], "mask": grey[1], "normal": normals,
        "canny": torch.from_numpy(np.repeat(edges[..., None], 3, 2)),
    }  # fmt: skip
    for name, picture in pictures.items():
        write_picture(folder / f"{name}.png", picture)
    (folder / "pose.json").write_text(json.dumps(keypoints(conditioning, conditioning.camera.width), indent=1))


def keypoints(conditioning: Conditioning, size: int) -> dict[str, object]:
    """The pose and camera as a file of `--keypoints` has them, for a picture of `size` pixels."""
    pose, K = conditioning.pose, conditioning.camera.K * (size / conditioning.camera.width)
    return {
        "side": conditioning.side,
        "angles": pose.angles.tolist(),
        "orientation": pose.orientation.tolist(),
        "translation": pose.translation.tolist(),
        "focal": float(K[0, 0]),
        "centre": K[:2, 2].tolist(),
    }
