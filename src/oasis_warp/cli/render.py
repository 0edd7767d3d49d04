"""`oasis render`: one picture of an avatar."""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.sky import environment_light, studio_light
from oasis_warp.cli.options import Animate, Render
from oasis_warp.cli.record import written
from oasis_warp.core.config import BLACK, WHITE
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError, did_you_mean
from oasis_warp.core.processes import single_threaded_math
from oasis_warp.core.types import HandPose
from oasis_warp.core.types import Render as Drawn
from oasis_warp.data.environment_map import read_environment
from oasis_warp.data.pictures import PICTURE_SUFFIXES, check_suffix, to_uint8, write_picture
from oasis_warp.hand.poses import POSE_NAMES
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion import read_motion

MAX_SIDE = 8192
"""Largest side of a picture [px]."""
COLORS = {"white": WHITE, "black": BLACK}


def check_numbers(options: Render | Animate) -> None:
    """Check device, size and angles of a command before any work.

    Raises:
        InputError: no such device, a picture too small or too large, or an angle that is no number.
    """
    check_device(options.device, "--")
    if not 16 <= options.size <= MAX_SIDE:
        raise InputError(f"--size {options.size}: expected 16 to {MAX_SIDE} pixels; choose another size.")
    for name in ("azimuth", "elevation"):
        angle = getattr(options, name, 0.0)
        if not math.isfinite(angle):
            raise InputError(f"--{name} {angle}: expected a number of degrees; write e.g. --{name} 45.")


def straight_alpha(drawn: Drawn) -> Float[Tensor, "H W 4"]:
    """A picture over black as RGBA whose colours are not multiplied with alpha."""
    return torch.cat([drawn.image / drawn.alpha.clamp_min(1e-6)[..., None], drawn.alpha[..., None]], -1)


def load_avatar(options: Render | Animate, path: Path) -> Avatar:
    """Load the avatar of a file in the chosen light.

    Raises:
        InputError: no avatar file, or no environment map.
    """
    if isinstance(options.light, Path):
        around = environment_light(read_environment(options.light))
    else:
        around = studio_light() if options.light == "studio" else None
    avatar = Avatar.load(path, options.device)
    if around is not None:
        return avatar.in_light(around)
    return avatar.in_even_light() if options.light == "even" else avatar


def read_color(text: str) -> tuple[float, float, float]:
    """The colour with the name or hex code `text`.

    Raises:
        InputError: `text` is neither.
    """
    if text in COLORS:
        return COLORS[text]
    digits = text.removeprefix("#")
    if len(digits) != 6 or not all(digit in "0123456789abcdefABCDEF" for digit in digits):
        names = ", ".join((*COLORS, "transparent"))
        raise InputError(f"--background {text}: expected {names} or six hex digits; write e.g. d0e0f0.")
    red, green, blue = bytes.fromhex(digits)
    return red / 255, green / 255, blue / 255


def choose_pose(avatar: Avatar, pose: str | Path) -> HandPose:
    """The pose of a name or a file, turned and placed as in the photo; "photo" is the pose in the photo.

    Raises:
        InputError: no such name or file, or no pose in it.
    """
    if isinstance(pose, Path) and not pose.suffix:
        hint = did_you_mean(str(pose), POSE_NAMES)
        raise InputError(f"--pose {pose}: expected {', '.join(POSE_NAMES)} or a file. {hint or 'Choose one.'}")
    if isinstance(pose, Path):
        return read_motion(pose, avatar).poses(avatar.source_pose)[0]
    return avatar.source_pose if pose == "photo" else avatar.held(pose)


@torch.no_grad()
@single_threaded_math()
def run(options: Render) -> int:
    """Write the picture.

    Raises:
        InputError: a wrong avatar file, option or output.
    """
    check_numbers(options)
    check_suffix(options.out, PICTURE_SUFFIXES)
    transparent = options.background == "transparent"
    background = BLACK if transparent else read_color(options.background)
    avatar = load_avatar(options, options.avatar)
    pose = choose_pose(avatar, options.pose)
    camera = avatar.orbit_camera(pose, math.radians(options.azimuth), math.radians(options.elevation), options.size)
    drawn = avatar.render(camera, pose, background)
    write_picture(options.out, to_uint8(straight_alpha(drawn) if transparent else drawn.image))
    written(options.out)
    return 0
