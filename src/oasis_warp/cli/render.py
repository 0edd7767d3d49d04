"""`oasis render`: one picture of an avatar."""

import math

import torch

from oasis_warp.cli.look import check_device, check_side, choose_pose, read_color
from oasis_warp.cli.options import Render
from oasis_warp.core.config import BLACK
from oasis_warp.data.pictures import PICTURE_SUFFIXES, check_suffix, to_uint8, write_picture
from oasis_warp.hand_avatar import Avatar
from oasis_warp.render.cameras import orbit_camera


@torch.no_grad()
def run(options: Render) -> int:
    """Draw the picture.

    Raises:
        InputError: a wrong avatar file, option or output.
    """
    check_device(options.device)
    check_side(options.size)
    check_suffix(options.out, PICTURE_SUFFIXES)
    transparent = options.background == "transparent"
    background = BLACK if transparent else read_color(options.background)
    avatar = Avatar.load(options.avatar, options.device)
    if options.light == "even":
        avatar = avatar.in_even_light()
    pose = choose_pose(avatar, options.pose)
    camera = orbit_camera(
        avatar.mesh(pose).vertices, math.radians(options.azimuth), math.radians(options.elevation), options.size
    )
    image, alpha = avatar.render(camera, pose, background)
    if transparent:  # drawn over black, so the colours have alpha multiplied in; picture files want them without
        image = torch.cat([image / alpha.clamp_min(1e-6)[..., None], alpha[..., None]], -1)
    write_picture(options.out, to_uint8(image))
    return 0
