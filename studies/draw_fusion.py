"""Draw avatars of single photos of a hand beside the one of all: the picture of docs/same_hand.md.

    D=tests/data/photos/same_hand/a1_wood_right
    python studies/draw_fusion.py -o docs/_static/fusion.jpg $D/02*.jpg $D/03*.jpg $D/05*.jpg

A column for each photo and one for all together; rows: the photo, then the open hand from the palm and from the back.
"""

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import HandPose
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import to_uint8, write_picture
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.fusion import reconstruct_same_hand
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar
from oasis_warp.reconstruction import CROP_MARGIN, reconstruct

TILE = 224
"""Side of a picture [px]."""
FACING = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Fingers up, palm to the camera."""


def both_sides(avatar: Avatar) -> Tensor:
    """The open hand from the palm, and below it from the back."""
    mirror = torch.tensor([-1.0 if avatar.side == "left" else 1.0, 1, 1])
    turn = mirror[:, None] * FACING * mirror
    pose = HandPose(named_pose(avatar.hand, "open"), turn, torch.tensor([0.0, 0.0, 0.5]))
    around = avatar.mesh(pose).vertices
    views = (avatar.render(orbit_camera(around, angle, size=TILE), pose).image for angle in (0.0, math.pi))
    return torch.cat(list(views))


def main() -> None:
    """Reconstruct and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--steps", type=int)
    options = parser.parse_args()
    photos, config = [read_photo(path) for path in options.photos], ReconstructConfig(steps=options.steps)
    columns = []
    for photo in photos:
        made = reconstruct(photo, config)
        square = square_around(made.fit.mask, CROP_MARGIN)
        crop = resample_square(photo.rgb.float() / 255, *square, TILE).clamp(0, 1)
        columns.append(torch.cat([crop, both_sides(made.avatar)]))
    together = both_sides(reconstruct_same_hand(photos, config).avatar)
    columns.append(torch.cat([torch.ones(TILE, TILE, 3), together]))
    write_picture(options.out, to_uint8(torch.cat(columns, 1)))


if __name__ == "__main__":
    main()
