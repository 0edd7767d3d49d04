"""`oasis animate`: a film of an avatar."""

import math

from rich.console import Console

from oasis_warp.cli.film import pose_film, turntable
from oasis_warp.cli.look import check_device, check_side, choose_pose, read_color
from oasis_warp.cli.options import Animate
from oasis_warp.cli.progress import show_progress
from oasis_warp.core.errors import InputError
from oasis_warp.data.pictures import VIDEO_SUFFIXES, check_suffix, write_video
from oasis_warp.hand.poses import POSE_NAMES
from oasis_warp.hand_avatar import Avatar

MAX_FRAMES = 10_000


def run(options: Animate) -> int:
    """Make the film.

    Raises:
        InputError: a wrong avatar file, option or output.
    """
    check_device(options.device)
    check_side(options.size)
    check_suffix(options.out, VIDEO_SUFFIXES)
    background = read_color(options.background)
    n_frames = count_frames(options.seconds, options.fps)
    names = read_names(options.poses)
    avatar = Avatar.load(options.avatar, options.device)
    if options.light == "even":
        avatar = avatar.in_even_light()
    with show_progress(Console(stderr=True)) as progress:
        look = {"elevation": math.radians(options.elevation), "background": background, "progress": progress}
        if options.motion == "turntable":
            frames = turntable(avatar, choose_pose(avatar, options.pose), n_frames, options.size, **look)
        else:
            frames = pose_film(avatar, names, n_frames, options.size, **look)
        write_video(options.out, frames, options.fps)
    return 0


def count_frames(seconds: float, fps: float) -> int:
    """Frames of a film.

    Raises:
        InputError: a rate or length that makes no film.
    """
    if not 1 <= fps <= 120:
        raise InputError(f"--fps {fps:g}: expected 1 to 120 frames a second; choose another rate.")
    if not 1 <= seconds * fps <= MAX_FRAMES:
        raise InputError(f"--seconds {seconds:g}: expected 1 to {MAX_FRAMES} frames, got {seconds * fps:g}; change it.")
    return round(seconds * fps)


def read_names(text: str) -> list[str]:
    """The pose names in `text`, which has commas between them.

    Raises:
        InputError: none, or an unknown one.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in POSE_NAMES]
    if unknown or not names:
        got = ", ".join(unknown) or "none"
        raise InputError(f"--poses {text}: expected names out of {', '.join(POSE_NAMES)}, got {got}; choose others.")
    return names
