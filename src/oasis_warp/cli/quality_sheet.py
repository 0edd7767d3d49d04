"""The picture of how well each place of the hand is known: what the photo shows, and how uncertain the rest is."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from oasis_warp.avatar.quality import SEEN, SurfaceQuality
from oasis_warp.cli.drawing import Panel, Pixels, make_sheet, panel_side
from oasis_warp.cli.summary import GROUND, WIDTH, shade_mesh
from oasis_warp.core.types import Camera, PosedHand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map
from oasis_warp.render.cameras import orbit_camera

SEEN_COLOR, GRAZED_COLOR, UNSEEN_COLOR = (0.30, 0.66, 0.42), (0.95, 0.76, 0.27), (0.62, 0.64, 0.68)


@torch.no_grad()
def draw_quality(title: str, avatar: Avatar, quality: SurfaceQuality) -> UInt8[Tensor, "H W 3"]:
    """Visibility and uncertainty on the hand in the (first) photo's pose, from that photo's side and from behind."""
    side = panel_side(4, WIDTH)
    posed = PosedHand(*(part.cpu() for part in avatar.mesh(avatar.source_pose)))
    faces, visibility = avatar.hand.faces.cpu(), quality.visibility.cpu()
    shown = torch.tensor(UNSEEN_COLOR).repeat(len(visibility), 1)
    shown[visibility > 0] = torch.tensor(GRAZED_COLOR)
    shown[visibility >= SEEN] = torch.tensor(SEEN_COLOR)
    panels = [
        Panel(_paint(posed, faces, colors, orbit_camera(posed.vertices, azimuth, size=side)), f"{what}, {where}")
        for what, colors in (("seen (green), grazed (yellow)", shown), ("uncertainty", _heat(quality.uncertainty)))
        for where, azimuth in (("from the photo's side", 0.0), ("from behind", math.pi))
    ]  # fmt: skip
    said = "uncertainty: blue is as the photo shows it, yellow is guessed"
    return torch.from_numpy(make_sheet(title, said, [panels], WIDTH))


def _heat(values: Float[Tensor, "V"]) -> Float[Tensor, "V 3"]:
    bytes_ = (values.cpu().clamp(0, 1) * 255).round().byte().numpy()[:, None]
    return torch.from_numpy(cv2.applyColorMap(bytes_, cv2.COLORMAP_CIVIDIS)[:, 0, ::-1].astype(np.float32) / 255)


def _paint(posed: PosedHand, faces: Tensor, colors: Float[Tensor, "V 3"], camera: Camera) -> Pixels:
    """The surface in the `colors` of its vertices, lit a little so that its shape can be seen."""
    seen = depth_map(posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    shade, inside = shade_mesh(posed, faces, camera)
    own = (colors[faces[seen.face_ids.clamp_min(0).long()]] * seen.barycentrics[..., None]).sum(-2)
    picture = torch.where(inside[..., None] > 0, own * (0.4 + 0.6 * shade)[..., None], torch.tensor(GROUND))
    return (picture.clamp(0, 1) * 255).round().byte().numpy()
