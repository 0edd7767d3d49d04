"""`oasis animate`: a video of an avatar."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import UInt8
from rich.console import Console
from torch import Tensor

from oasis_warp.cli.console import show_progress
from oasis_warp.cli.options import Animate
from oasis_warp.cli.render import check_output, choose_pose, load_avatar, read_color
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress
from oasis_warp.core.types import Color, HandPose
from oasis_warp.data.pictures import VIDEO_SUFFIXES, to_uint8, write_video
from oasis_warp.hand.poses import POSE_NAMES, pose_sequence
from oasis_warp.hand_avatar import Avatar
from oasis_warp.render.render import render

MAX_FRAMES = 10_000


@torch.no_grad()
def turntable(
    avatar: Avatar, pose: HandPose, n_frames: int, size: int, *, elevation: float, background: Color, progress: Progress
) -> Iterator[UInt8[Tensor, "size size 3"]]:
    """`n_frames` views around the hand in `pose`, from the photo's view on, `elevation` [rad] above the hand."""
    gaussians, vertices = avatar.pose(pose), avatar.mesh(pose).vertices
    for frame in range(n_frames):
        camera = orbit_camera(vertices, 2 * math.pi * frame / n_frames, elevation, size)
        yield to_uint8(render(gaussians, camera, background=background).image)
        progress("turntable", frame + 1, n_frames)


@torch.no_grad()
def pose_frames(
    avatar: Avatar,
    names: Sequence[str],
    n_frames: int,
    size: int,
    *,
    elevation: float,
    background: Color,
    progress: Progress,
) -> Iterator[UInt8[Tensor, "size size 3"]]:
    """About `n_frames` frames through the named poses and back to the first, from the direction of the photo.

    The camera does not move and sees all poses completely.
    """
    steps = max(1, round(n_frames / len(names)))
    poses = [avatar.source_pose._replace(angles=angles) for angles in pose_sequence(avatar.hand, names, steps)]
    reach = torch.cat([avatar.mesh(pose).vertices for pose in poses[:: max(1, steps // 2)]])
    camera = orbit_camera(reach, 0.0, elevation, size)
    for frame, pose in enumerate(poses):
        yield to_uint8(avatar.render(camera, pose, background).image)
        progress("poses", frame + 1, len(poses))


def run(options: Animate) -> int:
    """Write the video.

    Raises:
        InputError: a wrong avatar file, option or output.
    """
    check_output(options, VIDEO_SUFFIXES)
    background = read_color(options.background)
    n_frames = count_frames(options.seconds, options.fps)
    names = read_names(options.poses)
    avatar = load_avatar(options)
    with show_progress(Console(stderr=True)) as progress:
        look = {"elevation": math.radians(options.elevation), "background": background, "progress": progress}
        if options.motion == "turntable":
            frames = turntable(avatar, choose_pose(avatar, options.pose), n_frames, options.size, **look)
        else:
            frames = pose_frames(avatar, names, n_frames, options.size, **look)
        write_video(options.out, frames, options.fps)
    return 0


def count_frames(seconds: float, fps: float) -> int:
    """Number of frames of a video.

    Raises:
        InputError: a rate or length out of range.
    """
    if not 1 <= fps <= 120:
        raise InputError(f"--fps {fps:g}: expected 1 to 120 frames a second; choose another rate.")
    if not 1 <= seconds * fps <= MAX_FRAMES:
        raise InputError(f"--seconds {seconds:g}: expected 1 to {MAX_FRAMES} frames, got {seconds * fps:g}; change it.")
    return round(seconds * fps)


def read_names(text: str) -> list[str]:
    """Split `text` at commas into pose names.

    Raises:
        InputError: none, or an unknown one.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in POSE_NAMES]
    if unknown or not names:
        got = ", ".join(unknown) or "none"
        raise InputError(f"--poses {text}: expected names out of {', '.join(POSE_NAMES)}, got {got}; choose others.")
    return names
